"""SHA-256 digests of a run's inputs: the rig, the files of its scenes and projector, and the
training volumes."""

import hashlib
import json
import os
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from jaxtyping import Float
from torch import Tensor

from mvrecon.core.files.checks import Refused
from mvrecon.geometry.cameras.camera import VECTORS, Cameras
from mvrecon.geometry.grid import Grid

RIG_KEY = "rig"
#: Significant decimals of a mm, so that processors' different sines give the same rig.
SIGNIFICANT_DECIMALS = 9


def of_rig(cameras: Cameras) -> str:
    """Digest of a camera record: sources, origins, steps u and v in mm, shape, kind of beam,
    extent.
    """
    vectors = {name: _rounded(getattr(cameras, name).tolist()) for name in VECTORS}
    record = {
        **vectors,
        "shape": list(cameras.shape),
        "parallel": cameras.parallel,
        "extent": cameras.extent,
    }
    return hashlib.sha256(json.dumps(record, sort_keys=True).encode()).hexdigest()


def of_grid(grid: Grid) -> str:
    """Digest of a grid: its shape and its affine in mm."""
    record = {"shape": list(grid.shape), "affine": _rounded(grid.affine.tolist())}
    return hashlib.sha256(json.dumps(record, sort_keys=True).encode()).hexdigest()


def of_volume(volume: Float[Tensor, "*c d h w"]) -> str:
    """Digest of a volume's float32 values, which identifies a case under any name."""
    values = volume.detach().cpu().float().contiguous().numpy()
    return hashlib.sha256(values.tobytes()).hexdigest()


def of_file(path: str | Path) -> str:
    """Digest of a file's bytes; of a folder, of all files below it with their names.

    Raises:
        OSError: it cannot be read.
    """
    if Path(path).is_dir():
        files = sorted(f for f in Path(path).rglob("*") if f.is_file())
        digests = {f.relative_to(path).as_posix(): of_file(f) for f in files}
        return hashlib.sha256(json.dumps(digests).encode()).hexdigest()
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def files_in(settings: Any) -> Iterator[str]:
    """The files and folders that a part's settings name: every existing `path`, and existing files
    of any other option, such as an attenuation map.
    """
    if isinstance(settings, Mapping):
        for key, value in settings.items():
            if isinstance(value, str) and (
                os.path.isfile(value) or (key == "path" and os.path.isdir(value))
            ):
                yield value
        settings = list(settings.values())
    if isinstance(settings, list | tuple):
        for item in settings:
            yield from files_in(item)


def compare(got: Mapping[str, str], expected: Mapping[str, str], where: str | Path) -> None:
    """Compare the digests that both mappings have, of the rig or of a file by its path.

    Args:
        got: digests of the current inputs.
        expected: recorded digests of a run.
        where: the record, for the message.

    Raises:
        Refused: one differs.
    """
    changed = [name for name in got if name in expected and got[name] != expected[name]]
    if changed:
        values = "; ".join(
            f"{name}: got sha256 {got[name][:16]}, expected {expected[name][:16]}"
            for name in changed
        )
        raise Refused(
            f"The inputs of this run have changed since, according to {where}: {values}. Restore "
            f"them"
        )


def _rounded(value: Any) -> Any:
    return (
        [_rounded(item) for item in value]
        if isinstance(value, list)
        else round(value, SIGNIFICANT_DECIMALS) + 0.0
    )
