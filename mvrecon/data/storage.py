"""Safe reading of foreign HDF5 files: data must be in the file itself, and no chunk may unpack to
more bytes than declared; and atomic writing of HDF5 files that fit in memory.
"""

import math
import struct
import zlib
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from itertools import product
from pathlib import Path
from typing import Any, BinaryIO

import h5py
import numpy as np

from mvrecon.core.files.atomic import written_whole
from mvrecon.core.files.checks import (
    EDGE,
    MAX_CHUNK_BYTES,
    MAX_DEFLATE_RATIO,
    VOLUME,
    Refused,
    file_errors,
    shown,
)
from mvrecon.core.files.keys import has_effect

#: Versions of HDF5 format to write, from the first with checksums of the layout.
FORMAT = ("v110", "v110")
SIGNATURE = b"\x89HDF\r\n\x1a\n"
#: Offset that ends a heap's list of free blocks.
LIST_END = 1


@contextmanager
def written(path: Path) -> Iterator[h5py.File]:
    """Context of a new HDF5 file, which is made in memory and then written at once, atomically:
    libhdf5 crashes at the end of the process if a disk has no space for an open file.

    Raises:
        OSError: no space, no permission; the message names `path`.
    """
    with written_whole(path) as part:
        with h5py.File(part, "w", driver="core", backing_store=False) as file:
            yield file
            file.flush()
            image = file.id.get_file_image()
        part.write_bytes(image)


def reading(path: str | Path) -> h5py.File:
    """Open an HDF5 file for reading.

    Raises:
        OSError: it cannot be opened as HDF5.
        Refused: the free list among the names of its root group is a cycle.
    """
    with Path(path).open("rb") as file:
        if _endless(file):
            raise Refused(
                f"{path}: expected a list of free blocks that ends, got a circle; is it damaged?"
            )
    return h5py.File(path, "r", locking="best-effort")


def _endless(file: BinaryIO) -> bool:
    """Whether the root group's free list is a cycle; libhdf5 detects other damage.

    Newer formats have none; files with a user block before the signature are not checked.
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
    while offset != LIST_END and offset not in seen:
        seen.add(offset)
        following = _bytes(file, blocks + offset, 8)
        if len(following) < 8:
            return False
        (offset,) = struct.unpack("<Q", following)
    return offset != LIST_END


def _bytes(file: BinaryIO, place: int, count: int) -> bytes:
    """Read bytes at a position of a file; fewer, or none, past its end."""
    if place >= 2**63:
        return b""
    file.seek(place)
    return file.read(count)


#: Filters built into HDF5; others would be loaded as libraries from HDF5_PLUGIN_PATH.
ALLOWED_FILTERS = {h5py.h5z.FILTER_DEFLATE, h5py.h5z.FILTER_SHUFFLE, h5py.h5z.FILTER_FLETCHER32}
MAX_CHUNKS = 2**16


#: The files that `held` keeps open, by their paths; None outside of it.
_HELD: ContextVar[dict[Path, h5py.File] | None] = ContextVar("held", default=None)


@contextmanager
def held() -> Iterator[None]:
    """Context in which `opened` opens each file once, and keeps it open: for readers that look into
    one many times.
    """
    files: dict[Path, h5py.File] = {}
    token = _HELD.set(files)
    try:
        yield
    finally:
        _HELD.reset(token)
        for file in files.values():
            file.close()


@contextmanager
def opened(
    path: Path, expected: str = "an HDF5 file", what: str = "cannot be opened"
) -> Iterator[h5py.File]:
    """Context of an open HDF5 file, in which any error names it.

    Raises:
        Refused: it cannot be opened or read; the message names what was expected.
    """
    with file_errors(path, what, f"is it cut short? Expected {expected}"):
        if (files := _HELD.get()) is None:
            with reading(path) as file:
                yield file
            return
        if path not in files:
            files[path] = reading(path)
        yield files[path]


def dataset_in(path: Path, file: h5py.File, name: str, expected: str = "one") -> h5py.Dataset:
    """Return a dataset that is stored in this file and unpacks to no more than it declares.

    Raises:
        Refused: it is missing, a link, stored elsewhere, filtered by a plugin, or larger than the
        file can hold.
    """
    link = file.get(name, getlink=True)
    if link is None:
        raise Refused(
            f"{path}: has no dataset {name!r}, only {shown(sorted(file))}; expected {expected}"
        )
    dataset = file[name] if isinstance(link, h5py.HardLink) else None
    if not isinstance(dataset, h5py.Dataset) or dataset.is_virtual or dataset.external:
        raise Refused(
            f"{path}: {name!r} is a link, a group or stored elsewhere; expected a dataset in the "
            f"file"
        )
    plist = dataset.id.get_create_plist()
    filters = [plist.get_filter(k)[0] for k in range(plist.get_nfilters())]
    if not set(filters) <= ALLOWED_FILTERS or len(set(filters)) < len(filters):
        raise Refused(
            f"{path}: {name!r} has the filters {filters}; expected gzip, shuffle and fletcher32, "
            f"each once"
        )
    ratio = MAX_DEFLATE_RATIO if h5py.h5z.FILTER_DEFLATE in filters else 1
    most = ratio * path.stat().st_size
    if dataset.shape is None:
        raise Refused(f"{path}: {dataset.name!r} is empty; expected numbers or text")
    item = dataset.id.get_type().get_size()
    whole, one = math.prod(dataset.shape) * item, math.prod(dataset.shape[1:]) * item
    chunk, plane = (math.prod(n or ()) * item for n in (dataset.chunks, dataset.shape[-2:]))
    largest = max(MAX_CHUNK_BYTES, plane if dataset.ndim > 2 else 0)  # a plane is read at once
    sizes = (
        f"{path}: {dataset.name!r} declares {dataset.shape} x {item} bytes, in chunks of "
        f"{dataset.chunks}"
    )
    if whole > most or one > VOLUME:
        raise Refused(f"{sizes}; expected at most {most} bytes, {VOLUME} at once")
    if chunk > largest or max(dataset.shape[1:], default=1) > EDGE:
        ones = "x".join(str(min(n, 2**10)) for n in (1, *dataset.shape[1:]))
        raise Refused(
            f"{sizes}; expected chunks of at most {largest} bytes and {EDGE} voxels along z, y and "
            f"x; h5repack -l {dataset.name}:CHUNK={ones} writes a copy with smaller chunks"
        )
    return dataset


#: Fields beside a data set by which NeXus scales it, with its name before them or alone (NXdata).
NEXUS_SCALES = ("scaling_factor", "offset")
#: Most numbers of an attribute that is compared with one that changes nothing.
MAX_NUMBERS = 16


def check_attributes(
    path: Path, item: h5py.Group | h5py.Dataset, known: Sequence[str] = ()
) -> None:
    """Check the attributes of a file, group or dataset that its reader does not know: those of
    NetCDF (scale_factor, add_offset, _FillValue, units), of DICOM (RescaleSlope) and their like;
    and the fields beside a dataset by which NeXus scales it.

    Raises:
        Refused: one that would change values or units; the message names it.
    """
    for name in item.attrs:
        if name not in known:
            _check_effect(
                path, item, name, item.attrs.get_id(name), f"attribute {name!r} of {item.name!r}"
            )
    if isinstance(item, h5py.Dataset):
        check_fields(path, item.parent, item.name.rpartition("/")[2])


def check_fields(path: Path, group: h5py.Group, own: str) -> None:
    """Check the fields in a group by which NeXus scales its member `own`.

    Raises:
        Refused: one that would change values; the message names it.
    """
    for name in (start + end for end in NEXUS_SCALES for start in ("", f"{own}_")):
        if link := group.get(name, getlink=True):
            field = group[name] if isinstance(link, h5py.HardLink) else link
            beside = f"{group.name.rstrip('/')}/{own}"
            if not isinstance(field, h5py.Group):
                _check_effect(path, group, name, field, f"field {name!r} beside {beside!r}")


def unknown_members(path: Path, file: h5py.File, known: Sequence[str]) -> list[str]:
    """Names of the data sets, groups and links of a file that its reader does not know.

    Raises:
        Refused: one that would change values, such as a slope of each volume.
    """
    names = [name for name in file if name not in known]
    for name in names:
        link = file.get(name, getlink=True)
        member = file[name] if isinstance(link, h5py.HardLink) else link
        _check_effect(path, file, name, member, f"field {name!r} beside {known[0]!r}")
    return names


def fields_in(group: h5py.Group, effects: Mapping[str, Any]) -> list[str]:
    """Names of the data sets in a group and of links, which are not followed; not the axes of other
    data sets, nor those whose value is 0 or, as a gain of 1, changes nothing.
    """
    found = []
    for name in group:
        link = group.get(name, getlink=True)
        field = group[name] if isinstance(link, h5py.HardLink) else link
        axis = isinstance(field, h5py.Dataset) and field.is_scale
        if axis or isinstance(field, h5py.Group | h5py.Datatype):
            continue
        value = value_in(group, name, field)
        if has_effect(name, value, effects) if has_effect(name, "", effects) else value != 0:
            found.append(name)
    return found


def _check_effect(path: Path, holder: Any, name: str, kind: Any, what: str) -> None:
    """Raise for an attribute of a holder, or a field in it, that would change values."""
    if has_effect(name, value := value_in(holder, name, kind)):
        raise Refused(
            f"{path}: expected no {what}, which the reader does not apply, got {value}; apply it, "
            f"and remove it"
        )


def value_in(holder: Any, name: str, kind: Any) -> Any:
    """A number of an attribute of a holder, or of a field in it; its type if it has others."""
    value = type(kind).__name__  # of a link, which is not followed
    if hasattr(kind, "shape"):
        few = kind.shape is not None and 0 < math.prod(kind.shape) <= MAX_NUMBERS
        own = holder.attrs if isinstance(kind, h5py.h5a.AttrID) else holder
        numbers = np.ravel(own[name]) * 1 if few and kind.dtype.kind in "biuf" else np.zeros(0)
        numbers = numbers.tolist()
        one = len({*map(str, numbers)}) == 1  # one of each axis, as [0 0]
        value = numbers[0] if one else numbers or str(kind.dtype)
    return value


def check_chunks(path: Path, dataset: h5py.Dataset, index: int | None = None) -> None:
    """Decompress the chunks of one volume, or of all, and check their sizes.

    Raises:
        Refused: a chunk that is missing or unpacks to more than its size; a dataset without chunks
        that was never written.
    """
    item = dataset.id.get_type().get_size()
    if dataset.chunks is None:
        if (got := dataset.id.get_storage_size()) < dataset.size * item:
            raise Refused(
                f"{path}: {dataset.name!r} has {got} of its {dataset.size * item} bytes; was it "
                f"written to its end?"
            )
        return
    size = math.prod(dataset.chunks) * item
    slack = (
        2 * size + 64
    )  # references to text take 16 bytes, not 8; checksums and incompressible data add some
    starts = [range(0, n, c) for n, c in zip(dataset.shape, dataset.chunks, strict=True)]
    if index is not None:
        starts[0] = starts[0][index // dataset.chunks[0] :][:1]
    if (count := math.prod(map(len, starts))) > MAX_CHUNKS:
        raise Refused(
            f"{path}: {dataset.name!r} is cut into {count} chunks, expected at most {MAX_CHUNKS}; "
            f"store it anew"
        )
    for offset in product(*starts):
        info = dataset.id.get_chunk_info_by_coord(offset)
        if info.byte_offset is None or not 0 < info.size <= slack:
            raise Refused(
                f"{path}: {dataset.name!r} has {info.size} bytes for the chunk {offset}, expected "
                f"1 to {slack}"
            )
        if dataset.compression == "gzip" and info.size * MAX_DEFLATE_RATIO > 2**20:
            _unfold(path, dataset.id.read_direct_chunk(offset)[1], slack)


def _unfold(path: Path, raw: bytes, most: int) -> None:
    stream, total = zlib.decompressobj(), 0
    while raw and not stream.eof:
        try:
            total += len(stream.decompress(raw, 2**20))
        except zlib.error:
            return  # not a stream: stored raw, or damaged, which reading detects
        if total > most:
            raise Refused(
                f"{path}: a chunk of {len(raw)} bytes unfolds to more than the {most} that it "
                f"declares"
            )
        raw = stream.unconsumed_tail
