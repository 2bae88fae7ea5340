"""Files of events: HDF5, one compressed chunk an event and array, each with a checksum.

    truth    [n d h w]   activity
    ideal    [n m v u]   noise-free views, in the projector's unit
    counts   [n m v u]   whole numbers, uint32
    dose     [n]         expected counts per unit of `ideal` as the detector sees it
    index    [n]         of the event in its series
    radon    [n a z s]   optional: sinograms of the slices, activity * mm
    pose     [n k]       optional: what was drawn, named by the header's `columns`
    backprojection [n d h w]  optional: A^T counts / (dose A^T 1), for networks in the volume
    others   [n d h w]   optional: the maps of the scene by name, such as attenuation in 1/mm

The attribute `header` is JSON: `format`, and the fields of `Header`.
"""

import json
from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass
from pathlib import Path

import h5py
import numpy as np

from mvrecon.core.files.atomic import written_whole
from mvrecon.core.files.checks import Refused, file_errors, shown
from mvrecon.data.hdf5 import FORMAT, reading
from mvrecon.data.storage import check_chunks, dataset_in
from mvrecon.data.texts import variable

EXPECTED = "a file of events: HDF5 with truth [n d h w], ideal and counts [n m v u], dose, index"
KIND = "mvrecon events 1"
#: Arrays of every file, and those that it may have, with their number of axes and kind of number;
#: any other one is a map.
NEEDED = {"truth": (4, "f"), "ideal": (4, "f"), "counts": (4, "u"), "dose": (1, "f")}
NEEDED["index"] = (1, "i")
OPTIONAL = {"radon": (4, "f"), "pose": (2, "f"), "backprojection": (4, "f")}
MAP = (4, "f")
#: Level of gzip: higher ones save 2 % of a file and cost several times the time.
LEVEL = 1
#: Most bytes of a header.
TEXT = 2**16


@dataclass(frozen=True)
class Header:
    """What all files of a data set share.

    Args:
        settings: SHA-256 of all that the events depend on.
        seed: the series of cases.
        affine: of the truth's grid, row by row: voxel index (x, y, z, 1) to world mm.
        columns: names of the numbers in `pose`.
    """

    settings: str
    seed: int
    affine: tuple[float, ...]
    columns: tuple[str, ...] = ()


def write_shard(
    path: Path,
    header: Header,
    indices: range,
    make: Callable[[int], dict[str, np.ndarray]],
) -> None:
    """Write the events of some indices, one at a time, whole or not at all.

    Raises:
        OSError: no space, no permission.
    """
    with written_whole(path) as part, h5py.File(part, "w", libver=FORMAT) as file:
        text = json.dumps({"format": KIND, **asdict(header)}).encode()
        file.attrs.create("header", text, dtype=h5py.string_dtype("utf-8", len(text)))
        fill(file, len(indices), (make(index) for index in indices))


def fill(file: h5py.File, count: int, events: Iterable[dict[str, np.ndarray]]) -> None:
    """Write so many events into a new file."""
    packed = {"compression": "gzip", "compression_opts": LEVEL, "shuffle": True}
    for k, arrays in enumerate(events):
        for name, values in arrays.items():
            if k == 0:
                chunks = (1, *values.shape) if values.ndim else (count,)
                sizes = {"shape": (count, *values.shape), "chunks": chunks, "fletcher32": True}
                file.create_dataset(name, dtype=values.dtype, **sizes, **packed)
            file[name][k] = values  # type: ignore[index]


def header_of(path: Path) -> tuple[Header, int]:
    """Header of a file, and how many events it has.

    Raises:
        Refused: not a file of events, cut short, or with arrays that do not agree.
    """
    with (
        file_errors(path, "cannot be opened", f"is it cut short? Expected {EXPECTED}"),
        reading(path) as file,
    ):
        return _header(path, file), len(checked(path, file)["index"])


def _header(path: Path, file: h5py.File) -> Header:
    kind = file.attrs.get_id("header") if "header" in file.attrs else None
    if kind is None or kind.shape != () or variable(kind.dtype) or kind.dtype.itemsize > TEXT:
        raise Refused(f"{path}: has no short text as its header; expected {EXPECTED}")
    values = json.loads(bytes(file.attrs["header"]).decode())  # type: ignore[arg-type]
    if not isinstance(values, dict) or values.pop("format", None) != KIND:
        raise Refused(f"{path}: has the header {shown(values)}, expected that of {KIND!r}")
    values["affine"] = tuple(float(x) for x in values["affine"])
    values["columns"] = tuple(str(name) for name in values["columns"])
    return Header(**values)


def checked(path: Path, file: h5py.File) -> dict[str, h5py.Dataset]:
    """The arrays of an open file of events.

    Raises:
        Refused: arrays that are missing, of another type or of another number of
            events; signed counts, which could be negative.
    """
    names = [*NEEDED, *(name for name in file if name not in NEEDED)]
    arrays = {name: dataset_in(path, file, name, EXPECTED) for name in names}
    for name, array in arrays.items():
        axes, kind = (NEEDED | OPTIONAL).get(name, MAP)
        if array.ndim != axes or array.dtype.kind != kind or len(array) != len(arrays["index"]):
            raise Refused(
                f"{path}: has {name} as {array.dtype} {array.shape}; expected "
                f"{ {'f': 'floats', 'u': 'whole numbers of at least 0', 'i': 'integers'}[kind] } "
                f"with {axes} axes, for {len(arrays['index'])} events"
            )
    return arrays


def verify(path: Path) -> None:
    """Read a file whole, and so its checksums.

    Raises:
        Refused: it is damaged; the message names it.
    """
    with (
        file_errors(path, "is damaged", "delete it to have it made again"),
        reading(path) as file,
    ):
        for array in checked(path, file).values():
            check_chunks(path, array)
            for k in range(0, len(array), array.chunks[0] if array.chunks else 1):
                _ = array[k]
