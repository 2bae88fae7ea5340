"""Write and read checkpoint files: each complete, with a checksum, and with the previous one beside
it.

A file is what `torch.save` writes, a zip archive, with the SHA-256 of all before it as the
archive's comment: other programs read it as they would without.
"""

import hashlib
import io
import struct
import warnings
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any, BinaryIO

import torch
from lightning.fabric.plugins import CheckpointIO
from torch import Tensor

from mvrecon.core.files.atomic import written_whole
from mvrecon.core.files.checks import Refused, file_errors, shown
from mvrecon.core.targets import inside
from mvrecon.training.checkpoint_check import check_archive

TAG = b"sha256:"
COMMENT = len(TAG) + 64


class DamagedCheckpoint(Refused):
    """A checkpoint whose bytes are not those that were written."""


class DurableCheckpoints(CheckpointIO):
    """How Lightning writes, reads and removes checkpoints of a run; see `write` and `read_newest`.

    A checkpoint to go on from may tell Lightning of older ones, to be removed: none outside the run
    folder is.

    Args:
        folder: the run folder.
    """

    def __init__(self, folder: Path):
        self.folder = folder

    def save_checkpoint(
        self, checkpoint: dict[str, Any], path: Any, storage_options: Any = None
    ) -> None:
        """Write; see `write`.

        Raises:
            PermissionError: a path outside the folder.
        """
        write(inside(path, self.folder, "A checkpoint's path"), checkpoint)

    def load_checkpoint(
        self, path: Any, map_location: Any = "cpu", weights_only: bool | None = None
    ) -> dict[str, Any]:
        """Read; see `read_newest`. Nothing but plain values and tensors is ever read."""
        return read_newest(Path(path))

    def remove_checkpoint(self, path: Any) -> None:
        """Remove a file.

        Raises:
            PermissionError: a path outside the folder.
        """
        inside(path, self.folder, "A checkpoint's path").unlink(missing_ok=True)


def previous(path: Path) -> Path:
    """Path to which the earlier checkpoint at `path` is moved."""
    return path.with_stem(f"{path.stem}.previous")


def not_finite(checkpoint: Mapping[str, Any]) -> list[str]:
    """Names of the weight tensors, averaged or not, that have an infinite value or NaN."""
    states = (checkpoint.get(key) or {} for key in ("state_dict", "current_model_state"))
    weights = (pair for state in states for pair in state.items())
    return [
        name for name, value in weights if isinstance(value, Tensor) and not value.isfinite().all()
    ]


def write(path: Path, checkpoint: Mapping[str, Any]) -> None:
    """Write a checkpoint to `path`; an earlier one is moved to `previous(path)`.

    After a full disk or a kill at any moment, at least one of the two files is complete.

    Raises:
        FloatingPointError: weights that are not finite, which must not take a good checkpoint's
            place.
        OSError: no space, no permission.
    """
    if bad := not_finite(checkpoint):
        raise FloatingPointError(
            f"{path} is not written: {len(bad)} weights are not finite, {bad[0]} among them"
        )
    buffer = io.BytesIO()
    torch.save(dict(checkpoint), buffer)
    buffer.seek(
        -2, io.SEEK_END
    )  # a zip archive ends with the length of its comment, and the comment
    buffer.write(struct.pack("<H", COMMENT))
    buffer.write(TAG + hashlib.sha256(buffer.getbuffer()).hexdigest().encode())
    with written_whole(path, previous(path)) as part:
        part.write_bytes(buffer.getbuffer())


def read(path: Path) -> dict[str, Any]:
    """Read a checkpoint of plain values and tensors and check its checksum, if it has one of
    mvrecon's.

    Raises:
        DamagedCheckpoint: the checksum does not fit, or the file is cut short.
        Refused: more than tensors and plain values, or weights that are not finite.
    """
    with open(path, "rb") as file:
        _verify(path, file)
        check_archive(path)
        file.seek(0)
        checkpoint = torch.load(file, map_location="cpu", weights_only=True)
    with file_errors(path, "is no checkpoint"):
        bad = not_finite(checkpoint)
    if bad:
        raise Refused(
            f"{path}: {len(bad)} weights are not finite, {shown(bad[0])} among them; expected "
            f"numbers"
        )
    return checkpoint


def remove(path: Path) -> None:
    """Remove a checkpoint and the one before it; then their folder, unless anything else is in
    it.
    """
    for file in (path, previous(path)):
        file.unlink(missing_ok=True)
    with suppress(OSError):
        path.parent.rmdir()


def read_newest(path: Path) -> dict[str, Any]:
    """The checkpoint at `path`, or, with a warning that names both, the one before it where that is
    damaged.

    Raises:
        FileNotFoundError: neither is there.
        DamagedCheckpoint: neither can be read.
    """
    before = previous(path)
    try:
        return read(path)
    except (DamagedCheckpoint, FileNotFoundError) as error:
        if not before.exists():
            raise
        why = error if isinstance(error, DamagedCheckpoint) else f"{path} is missing"
        warnings.warn(
            f"{why}; going on from the one before it, {before}", RuntimeWarning, stacklevel=2
        )
        return read(before)


def _verify(path: Path, file: BinaryIO) -> None:
    size = file.seek(0, io.SEEK_END)
    file.seek(max(0, size - COMMENT))
    tail = file.read()
    if tail[-22:].startswith(b"PK\5\6"):  # an archive without a comment
        return
    if not tail.startswith(TAG):
        raise DamagedCheckpoint(
            f"{path} is cut short or no checkpoint: {size} bytes, whose end is missing"
        )
    file.seek(0)
    digest, remaining = hashlib.sha256(), size - COMMENT
    while block := file.read(min(remaining, 2**20)):
        digest.update(block)
        remaining -= len(block)
    if digest.hexdigest().encode() != tail[len(TAG) :]:
        raise DamagedCheckpoint(f"{path} is damaged: its checksum does not fit its contents")
