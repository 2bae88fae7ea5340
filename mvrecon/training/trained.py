"""A trained method, from the path of its checkpoint, of its weights or of its run."""

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from torch import Tensor

from mvrecon import __version__
from mvrecon.core.files.atomic import written_whole
from mvrecon.core.files.checks import TEXT, Refused, file_errors, shown
from mvrecon.core.files.runs import folder_of_run, of_weights, shipped_weights
from mvrecon.core.registry import hint, import_plugins
from mvrecon.training import checkpoints
from mvrecon.training import trained as weights_file
from mvrecon.training.checkpoint_check import check_settings
from mvrecon.training.checkpoints import Trained
from mvrecon.training.module import ReconstructionModule, methods
from mvrecon.training.run_folder import read_settings
from mvrecon.training.storage import not_finite

#: Ending of such files; the key of their text.
ENDING, KEY = ".safetensors", "mvrecon"
#: In place of a file's SHA-256, where it is computed.
UNSEALED = "0" * 64


def write(path: str | Path, trained: Trained) -> Path:
    """Write a trained method's weights, its settings and how it was trained; returns the path.

    The file's metadata are JSON under the key `mvrecon`: `settings` (grid and rig in mm, projector,
    model, loss, optimiser, value range), `training` (version, steps, seconds, number of cases) and
    `sha256`, that of the whole file with zeros in its place.

    Raises:
        ValueError: another ending than .safetensors.
    """
    from safetensors.torch import save

    path = Path(path).expanduser()
    if path.suffix != ENDING:
        raise ValueError(f"Expected a file {ENDING}, got {path}")
    module = trained.module
    weights = {name: value.cpu().contiguous() for name, value in module.state_dict().items()}
    training = {
        "version": __version__,
        "steps": trained.steps,
        "seconds": round(trained.seconds, 1),
        "cases": None if trained.cases is None else len(trained.cases),
    }
    record = {"sha256": UNSEALED, "settings": dict(module.hparams), "training": training}
    raw = save(weights, {KEY: json.dumps(record, allow_nan=False)})
    with written_whole(path) as part:
        part.write_bytes(raw.replace(UNSEALED.encode(), _digest(raw).encode(), 1))
    return path


def read(path: Path) -> Trained:
    """A trained method from such a file; nothing in it is run.

    Raises:
        FileNotFoundError: it is not there.
        Refused: cut short or damaged, no file of mvrecon's, weights that are not finite, or not the
            weights of the method that it describes.
    """
    from safetensors import safe_open

    if not path.is_file():
        raise FileNotFoundError(f"No weights are at {path}")
    with file_errors(path, f"is no {ENDING} file"), safe_open(path, framework="pt") as file:
        text = (file.metadata() or {}).get(KEY, "")
        weights = {name: file.get_tensor(name) for name in file.keys()}
    if not 0 < len(text) <= TEXT:
        raise Refused(f"{path}: expected a description under {KEY!r} of at most {TEXT} bytes")
    with file_errors(path, "is not described by JSON"):
        record = json.loads(text)
        digest, settings, training = (record[key] for key in ("sha256", "settings", "training"))
        found = _digest(path.read_bytes(), digest)
    if digest != found:
        raise Refused(
            f"{path}: is damaged, or of an earlier version: expected the SHA-256 {shown(digest)}, "
            f"got {found}"
        )
    if bad := not_finite({"state_dict": weights}):
        raise Refused(f"{path}: {len(bad)} weights are not finite, {shown(bad[0])} among them")
    return _trained(path, settings, weights, training)


def _trained(
    path: Path, settings: Any, weights: dict[str, Tensor], training: Mapping[str, Any]
) -> Trained:
    with file_errors(
        path, "does not fit this version's method", "was it written by another version?"
    ):
        module = ReconstructionModule(**check_settings(path, settings))
        module.load_state_dict(weights)
        seconds, steps = float(training["seconds"]), int(training["steps"])
    return Trained(module.eval(), seconds, steps, cases=None)


def _digest(raw: bytes, digest: str = UNSEALED) -> str:
    """SHA-256 of a file's bytes with zeros in place of the digest in its description."""
    return hashlib.sha256(raw.replace(digest.encode(), UNSEALED.encode(), 1)).hexdigest()


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
