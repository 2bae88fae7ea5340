"""SHA-256 digests of a run's measurement: of the rig, and of the files that its scenes read."""

import hashlib
import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from mvrecon.cameras.camera import VECTORS, Cameras
from mvrecon.files.checks import Refused

RIG = "rig"
#: Decimals of a mm that count: a rig that another processor's sine and cosine make is the same rig.
DECIMALS = 9


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


def of_file(path: str | Path) -> str:
    """Digest of a file's bytes.

    Raises:
        OSError: it cannot be read.
    """
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def files_in(settings: Any) -> Iterator[str]:
    """The files that a part's settings name: every `path` in them at which a file is, or a folder
    of files.
    """
    if isinstance(settings, Mapping):
        path = settings.get("path")
        if isinstance(path, str) and Path(path).is_file():
            yield path
        elif isinstance(path, str) and Path(path).is_dir():
            yield from sorted(str(file) for file in Path(path).rglob("*") if file.is_file())
        settings = list(settings.values())
    if isinstance(settings, list | tuple):
        for item in settings:
            yield from files_in(item)


def compare(got: Mapping[str, str], expected: Mapping[str, str], where: str | Path) -> None:
    """Compare the digests that both mappings have, of the rig or of a file by its path.

    Args:
        got: digests of what is there now.
        expected: digests of what a run was made with.
        where: the run keeps them, for the message.

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
            f"What the run was made with has changed since, as {where} tells: {values}. Put it "
            f"back as it was"
        )


def _rounded(value: Any) -> Any:
    return (
        [_rounded(item) for item in value]
        if isinstance(value, list)
        else round(value, DECIMALS) + 0.0
    )
