"""A trained method, from the path of its checkpoint or of its run."""

from pathlib import Path

from mvrecon.config.plugins import import_plugins
from mvrecon.engine import checkpoints
from mvrecon.engine.checkpoints import Trained
from mvrecon.engine.fit import methods
from mvrecon.engine.run_folder import read_settings


def load(path: str | Path, method: str | None = None) -> Trained:
    """A trained method: `load(path)(views)` is its reconstruction,
    `load(path)(views, cameras, grid)` that of another rig and grid.

    Args:
        path: of a checkpoint, or of a run folder; the modules that the run's setting `plugins`
            names are imported.
        method: its label in the run's table; None: the run's main method. A checkpoint holds one
            method, and needs no label.

    Raises:
        FileNotFoundError: nothing is there, or the method's training has not ended.
        LookupError: the run has no method of that label.
        DamagedCheckpoint: the file is not what was written.
        Refused: more than tensors and plain values, or not the weights of the method that it
            describes.
    """
    path = Path(path).expanduser()
    if path.is_file():
        return checkpoints.load(path)
    folder = checkpoints.run_folder(path)
    settings = read_settings(folder)
    labels = list(methods(settings))
    if method is not None and method not in labels:
        raise LookupError(f"The run {folder} has no method {method!r}. It has {', '.join(labels)}")
    import_plugins(settings["plugins"])
    return checkpoints.load(checkpoints.finished(folder, method or labels[0]))
