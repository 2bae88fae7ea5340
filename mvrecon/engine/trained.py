"""A trained method, from the path of its checkpoint, of its weights or of its run."""

from pathlib import Path

from mvrecon.config.plugins import import_plugins
from mvrecon.engine import checkpoints, weights_file
from mvrecon.engine.checkpoints import Trained
from mvrecon.engine.labels import methods
from mvrecon.engine.module import ReconstructionModule
from mvrecon.engine.run_folder import read_settings
from mvrecon.engine.weights_file import ENDING
from mvrecon.files.places import of_weights, shipped_weights
from mvrecon.files.runs import folder_of_run
from mvrecon.registry import hint


def load(path: str | Path, method: str | None = None) -> Trained:
    """A trained method: `load(path)(views)` is its reconstruction,
    `load(path)(views, cameras, grid)` that of another rig and grid.

    Args:
        path: of a checkpoint, of weights (.safetensors) or of a run folder, whose modules in the
            setting `plugins` are imported; or the name of weights that are part of mvrecon.
        method: its label in the run's table; None: the run's main method. A checkpoint holds one
            method, and needs no label.

    Raises:
        FileNotFoundError: nothing is there, or the method's training has not ended.
        LookupError: the run has no method of that label.
        DamagedCheckpoint: the file is not what was written.
        Refused: more than tensors and plain values, or not the weights of the method that it
            describes.
    """
    path = of_weights(path)
    if path.is_file():
        return weights_file.read(path) if path.suffix == ENDING else checkpoints.load(path)
    if not path.exists():
        raise FileNotFoundError(
            f"No checkpoint or run folder is at {path}{hint(path.name, shipped_weights())}"
        )
    folder = folder_of_run(path)
    settings = read_settings(folder)
    labels = list(methods(settings))
    if method is not None and method not in labels:
        raise LookupError(f"The run {folder} has no method {method!r}. It has {', '.join(labels)}")
    import_plugins(settings["plugins"])
    return checkpoints.load(checkpoints.finished(folder, method or labels[0]))


def save_weights(run: str | Path, path: str | Path, method: str | None = None) -> Path:
    """Write a trained method's weights and settings into one file, for others and for other rigs;
    returns its path.

    Args:
        run: as the `path` of `load`.
        path: of the file, which ends with .safetensors.
        method: its label in the run's table; None: the run's main method.

    Raises:
        ValueError: another ending; what `load` raises.
    """
    return weights_file.write(path, load(run, method))


def begin_from(path: str | Path, module: ReconstructionModule) -> None:
    """Give a method the weights of a trained one, to go on learning on other data, another rig or
    grid; the optimiser and the schedule begin anew.

    Args:
        path: as that of `load`: a run (its main method), a checkpoint or a file of weights.
        module: with the same method.

    Raises:
        ValueError: weights of another method; what `load`
            raises.
    """
    weights = load(path).module.method.state_dict()
    own = module.method.state_dict()
    differing = [
        name
        for name in {**weights, **own}
        if name not in weights or name not in own or weights[name].shape != own[name].shape
    ]
    if differing:
        raise ValueError(
            f"init_from={path}: expected weights of the same method, of whatever rig and grid; got "
            f"{len(differing)} that are not those of {module.hparams['method']['name']!r}, "
            f"{differing[0]} among them"
        )
    module.method.load_state_dict(weights)
