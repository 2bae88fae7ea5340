"""Trained weights for others: one safetensors file of tensors and plain text, without a run folder
around it.
"""

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from torch import Tensor

from mvrecon import __version__
from mvrecon.engine.checkpoint_check import check_settings
from mvrecon.engine.checkpoints import Trained
from mvrecon.engine.module import ReconstructionModule
from mvrecon.engine.storage import not_finite
from mvrecon.files.atomic import written_whole
from mvrecon.files.checks import TEXT, Refused, blaming, shown

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
    with blaming(path, f"is no {ENDING} file"), safe_open(path, framework="pt") as file:
        text = (file.metadata() or {}).get(KEY, "")
        weights = {name: file.get_tensor(name) for name in file.keys()}
    if not 0 < len(text) <= TEXT:
        raise Refused(f"{path}: expected a description under {KEY!r} of at most {TEXT} bytes")
    with blaming(path, "is not described by JSON"):
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
    with blaming(path, "does not fit this version's method", "was it written by another version?"):
        module = ReconstructionModule(**check_settings(path, settings))
        module.load_state_dict(weights)
        seconds, steps = float(training["seconds"]), int(training["steps"])
    return Trained(module.eval(), seconds, steps, cases=None)


def _digest(raw: bytes, digest: str = UNSEALED) -> str:
    """SHA-256 of a file's bytes with zeros in place of the digest in its description."""
    return hashlib.sha256(raw.replace(digest.encode(), UNSEALED.encode(), 1)).hexdigest()
