"""Opening of HDF5 files for reading, all of them.

In the oldest format, which h5py writes by default, the names of a group lie in a heap, and the
heap's free blocks are a list, each with the offset of the next (HDF5 File Format Specification 3.0,
III.D). libhdf5 2.0.0 follows that list without counting: where a damaged offset makes it a circle,
it takes memory until there is none. So the list of the root group is followed here before.
"""

import struct
from pathlib import Path
from typing import BinaryIO

import h5py

from mvrecon.files.checks import Refused

SIGNATURE = b"\x89HDF\r\n\x1a\n"
#: Offset that ends a heap's list of free blocks.
END = 1


def reading(path: str | Path) -> h5py.File:
    """HDF5 file, opened for reading.

    Raises:
        OSError: it cannot be opened as HDF5.
        Refused: the list of free blocks among the names of its root group is a circle.
    """
    with Path(path).open("rb") as file:
        if _endless(file):
            raise Refused(
                f"{path}: expected a list of free blocks that ends, got a circle; is it damaged?"
            )
    return h5py.File(path, "r", locking="best-effort")


def _endless(file: BinaryIO) -> bool:
    """Whether the root group's free blocks are a circle; what else is amiss libhdf5 tells.

    A file of the newer formats has none, one with a block of the user's before its signature is not
    looked into.
    """
    head = file.read(100)
    if len(head) < 100 or head[:8] != SIGNATURE or head[8] > 1 or head[13:15] != b"\x08\x08":
        return False
    (heap,) = struct.unpack_from("<Q", head, 88 + 4 * head[8])
    header = _bytes(file, heap, 32)
    if header[:4] != b"HEAP":
        return False
    offset, blocks = struct.unpack_from("<QQ", header, 16)
    seen: set[int] = set()
    while offset != END and offset not in seen:
        seen.add(offset)
        following = _bytes(file, blocks + offset, 8)
        if len(following) < 8:
            return False
        (offset,) = struct.unpack("<Q", following)
    return offset != END


def _bytes(file: BinaryIO, place: int, count: int) -> bytes:
    """Bytes at a place of a file; fewer, or none, behind its end."""
    if place >= 2**63:
        return b""
    file.seek(place)
    return file.read(count)
