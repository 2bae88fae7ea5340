"""Checkpoint files that survive: put in place whole, with a checksum inside, and the one before kept beside it.

A file is what `torch.save` writes, a zip archive, with the SHA-256 of all before it as the archive's comment: other
programs read it as they would without.
"""

import hashlib
import io
import struct
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any, BinaryIO

import torch
from lightning.fabric.plugins import CheckpointIO
from torch import Tensor

from mvrecon.durable import written_whole
from mvrecon.engine.archive import check_archive
from mvrecon.limits import Refused

TAG = b"sha256:"
COMMENT = len(TAG) + 64


class DamagedCheckpoint(Refused):
    """A checkpoint whose bytes are not those that were written."""


class DurableCheckpoints(CheckpointIO):
    """How Lightning writes and reads checkpoints of a run; see `write` and `read_newest`."""

    def save_checkpoint(self, checkpoint: dict[str, Any], path: Any, storage_options: Any = None) -> None:
        """Write; see `write`."""
        write(Path(path), checkpoint)

    def load_checkpoint(self, path: Any, map_location: Any = "cpu", weights_only: bool | None = None) -> dict[str, Any]:
        """Read; see `read_newest`. Nothing but plain values and tensors is ever read."""
        return read_newest(Path(path))

    def remove_checkpoint(self, path: Any) -> None:
        """Remove a file."""
        Path(path).unlink(missing_ok=True)


def previous(path: Path) -> Path:
    """Where the checkpoint goes that was at `path` before."""
    return path.with_stem(f"{path.stem}.previous")


def write(path: Path, checkpoint: Mapping[str, Any]) -> None:
    """Put a checkpoint on the disk under its name; the one that was there stays, as `previous(path)`.

    Whatever goes wrong, a full disk or a kill at any moment, one of the two is whole.

    Raises:
        FloatingPointError: weights that are not finite, which must not take a good checkpoint's place.
        OSError: no space, no permission.
    """
    weights = checkpoint.get("state_dict", {})
    if bad := [name for name, value in weights.items() if isinstance(value, Tensor) and not value.isfinite().all()]:
        raise FloatingPointError(f"{path} is not written: {len(bad)} weights are not finite, {bad[0]} among them")
    buffer = io.BytesIO()
    torch.save(dict(checkpoint), buffer)
    buffer.seek(-2, io.SEEK_END)  # a zip archive ends with the length of its comment, and the comment
    buffer.write(struct.pack("<H", COMMENT))
    buffer.write(TAG + hashlib.sha256(buffer.getbuffer()).hexdigest().encode())
    with written_whole(path, previous(path)) as part:
        part.write_bytes(buffer.getbuffer())


def read(path: Path) -> dict[str, Any]:
    """A checkpoint of plain values and tensors, checked; one without a checksum of ours is taken as it is.

    Raises:
        DamagedCheckpoint: the checksum does not fit, or the file is cut short.
    """
    with open(path, "rb") as file:
        _verify(path, file)
        check_archive(path)
        file.seek(0)
        return torch.load(file, map_location="cpu", weights_only=True)


def read_newest(path: Path) -> dict[str, Any]:
    """The checkpoint at `path`, or, with a warning that names both, the one before it where that is damaged.

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
        warnings.warn(f"{why}; going on from the one before it, {before}", RuntimeWarning, stacklevel=2)
        return read(before)


def _verify(path: Path, file: BinaryIO) -> None:
    size = file.seek(0, io.SEEK_END)
    file.seek(max(0, size - COMMENT))
    tail = file.read()
    if tail[-22:].startswith(b"PK\5\6"):  # an archive without a comment
        return
    if not tail.startswith(TAG):
        raise DamagedCheckpoint(f"{path} is cut short or no checkpoint: {size} bytes, whose end is missing")
    file.seek(0)
    digest, left = hashlib.sha256(), size - COMMENT
    while block := file.read(min(left, 2**20)):
        digest.update(block)
        left -= len(block)
    if digest.hexdigest().encode() != tail[len(TAG) :]:
        raise DamagedCheckpoint(f"{path} is damaged: its checksum does not fit its contents")
