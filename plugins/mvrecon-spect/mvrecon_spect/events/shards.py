"""Files of events: HDF5, with one compressed chunk and checksum per event and array.

    truth    [n d h w]   activity
    ideal    [n m v u]   noise-free views, in the projector's unit
    counts   [n m v u]   integers, uint32
    dose     [n]         expected counts per unit of `ideal` as detected
    index    [n]         of the event in its series
    radon    [n a z s]   optional: sinograms of the slices, activity * mm
    pose     [n k]       optional: random parameters, named in the header's `columns`
    backprojection [n d h w]  optional: A^T counts / (dose A^T 1), for networks in the volume
    others   [n d h w]   optional: the maps of the scene by name, such as attenuation in 1/mm

The attribute `header` is JSON: `format`, and the fields of `Header`.
"""

import json
import os
from bisect import bisect_right
from collections import OrderedDict
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass
from itertools import accumulate
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import torch
from torch.utils.data import Dataset

from mvrecon.core.files.atomic import written_whole
from mvrecon.core.files.checks import Refused, file_errors, shown
from mvrecon.core.registry import hint
from mvrecon.data.storage import FORMAT, check_chunks, dataset_in, opened, reading
from mvrecon.data.texts import variable
from mvrecon.geometry.grid import Grid

EXPECTED = "a file of events: HDF5 with truth [n d h w], ideal and counts [n m v u], dose, index"
KIND = "mvrecon events 1"
#: Required and optional arrays of a file, with their number of axes and kind of dtype; all other
#: arrays are maps.
NEEDED = {"truth": (4, "f"), "ideal": (4, "f"), "counts": (4, "u"), "dose": (1, "f")}
NEEDED["index"] = (1, "i")
OPTIONAL = {"radon": (4, "f"), "pose": (2, "f"), "backprojection": (4, "f")}
MAP = (4, "f")
#: Gzip level: higher levels save 2 % of the size and take several times as long.
LEVEL = 1
#: Maximum size of a header in bytes.
TEXT = 2**16


@dataclass(frozen=True)
class Header:
    """Metadata shared by all files of a data set.

    Args:
        settings: SHA-256 of everything that determines the events.
        seed: seed of the series of cases.
        affine: affine of the truth's grid, row by row: voxel index (x, y, z, 1) to world mm.
        columns: names of the numbers in `pose`.
    """

    settings: str
    seed: int
    affine: tuple[float, ...]
    columns: tuple[str, ...] = ()


def write_shard(
    path: Path, header: Header, indices: range, make: Callable[[int], dict[str, np.ndarray]]
) -> None:
    """Write the events with the given indices one at a time; the file is written atomically.

    Raises:
        OSError: insufficient space or permissions.
    """
    with written_whole(path) as part, h5py.File(part, "w", libver=FORMAT) as file:
        text = json.dumps({"format": KIND, **asdict(header)}).encode()
        file.attrs.create("header", text, dtype=h5py.string_dtype("utf-8", len(text)))
        fill(file, len(indices), (make(index) for index in indices))


def fill(file: h5py.File, count: int, events: Iterable[dict[str, np.ndarray]]) -> None:
    """Write a number of events to a new file."""
    packed = {"compression": "gzip", "compression_opts": LEVEL, "shuffle": True}
    for k, arrays in enumerate(events):
        for name, values in arrays.items():
            if k == 0:
                chunks = (1, *values.shape) if values.ndim else (count,)
                sizes = {"shape": (count, *values.shape), "chunks": chunks, "fletcher32": True}
                file.create_dataset(name, dtype=values.dtype, **sizes, **packed)
            file[name][k] = values  # type: ignore[index]


def header_of(path: Path) -> tuple[Header, int]:
    """Header and number of events of a file.

    Raises:
        Refused: not a file of events, a truncated one, or inconsistent arrays.
    """
    with opened(path, EXPECTED) as file:
        kind = file.attrs.get_id("header") if "header" in file.attrs else None
        if kind is None or kind.shape != () or variable(kind.dtype) or kind.dtype.itemsize > TEXT:
            raise Refused(f"{path}: has no short text as its header; expected {EXPECTED}")
        values = json.loads(bytes(file.attrs["header"]).decode())  # type: ignore[arg-type]
        if not isinstance(values, dict) or values.pop("format", None) != KIND:
            raise Refused(f"{path}: has the header {shown(values)}, expected that of {KIND!r}")
        values["affine"] = tuple(float(x) for x in values["affine"])
        values["columns"] = tuple(str(name) for name in values["columns"])
        return Header(**values), len(checked(path, file)["index"])


def checked(path: Path, file: h5py.File) -> dict[str, h5py.Dataset]:
    """The arrays of an open file of events.

    Raises:
        Refused: arrays that are missing or have a wrong dtype or number of events; signed counts,
            which could be negative.
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
    """Read an entire file to verify its checksums.

    Raises:
        Refused: the file is damaged; the message contains its path.
    """
    with file_errors(path, "is damaged", "delete it to have it made again"), reading(path) as file:
        for array in checked(path, file).values():
            check_chunks(path, array)
            for k in range(0, len(array), array.chunks[0] if array.chunks else 1):
                _ = array[k]


#: Maximum number of open files per process.
OPEN = 16


class Events(Dataset[dict[str, Any]]):
    """Events in the files of a folder, read one at a time; can be used in any process.

    An item contains the arrays in `names` as float32 with a leading channel axis: "truth",
    "backprojection", the scene's maps [1 d h w], "ideal", "counts" [1 m v u] and "radon" [1 a z s];
    also "dose" and "pose" [k] (float64) and "index". `columns` contains the names of the columns of
    "pose".

    Args:
        folder: folder of the files, or several folders of one series.
        names: names of the arrays to read.

    Raises:
        FileNotFoundError: no files of events.
        LookupError: the files do not contain the arrays.
        Refused: not a file of events, or a file with another grid.
    """

    def __init__(
        self,
        folder: str | Path | Sequence[str | Path],
        names: Sequence[str] = ("counts", "truth", "dose"),
    ):
        folders = [folder] if isinstance(folder, str | Path) else list(folder)
        self.paths = [path for one in folders for path in sorted(Path(one).glob("events-*.h5"))]
        if not self.paths:
            raise FileNotFoundError(f"{folder}: no files events-*.h5; expected {EXPECTED}")
        headers = [header_of(path) for path in self.paths]
        self.header, self.names = headers[0][0], tuple(names)
        self.columns = self.header.columns
        self._ends = list(accumulate(count for _, count in headers))
        self._reset()
        self._kinds = self._kinds_of(0)
        if unknown := [name for name in names if name not in self._kinds]:
            raise LookupError(
                f"{self.paths[0]} has no array {unknown[0]!r}{hint(unknown[0], self._kinds)}"
            )
        for k, (header, _) in enumerate(headers):
            if header.affine != self.header.affine or header.columns != self.columns:
                raise Refused(f"{self.paths[k]}: expected the grid and columns of {self.paths[0]}")

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_files": None, "_sound": None, "_process": None}

    def __len__(self) -> int:
        return self._ends[-1]

    @property
    def grid(self) -> Grid:
        """Grid of the truth."""
        affine = torch.tensor(self.header.affine, dtype=torch.float64).reshape(4, 4)
        return Grid(self._kinds["truth"], affine)  # type: ignore[arg-type]

    def __getitem__(self, item: int) -> dict[str, Any]:
        if not 0 <= item < len(self):
            raise IndexError(f"A data set of {len(self)} events has no item {item}")
        shard = bisect_right(self._ends, item)
        row = item - (self._ends[shard - 1] if shard else 0)
        path, arrays = self.paths[shard], self._arrays(shard)
        event: dict[str, Any] = {}
        with file_errors(path, f"event {row} cannot be read", "is it damaged?"):
            for name in self.names:
                if (shard, row, name) not in self._sound:
                    check_chunks(path, arrays[name], row)
                    self._sound.add((shard, row, name))
                values: Any = arrays[name][row]
                if values.ndim < 3:  # numbers and lists
                    event[name] = torch.as_tensor(values, dtype=torch.float64)
                else:
                    event[name] = torch.from_numpy(values.astype("float32", copy=False))[None]
            event["index"] = int(arrays["index"][row])
        return event

    def _reset(self) -> None:
        self._process = os.getpid()
        self._files: OrderedDict[int, tuple[h5py.File, dict[str, h5py.Dataset]]] = OrderedDict()
        self._sound: set[tuple[int, int, str]] = set()

    def _arrays(self, shard: int) -> dict[str, h5py.Dataset]:
        """The arrays of a file, opened in this process."""
        if self._process != os.getpid():
            self._reset()
        if shard not in self._files:
            path = self.paths[shard]
            with file_errors(path, "cannot be opened", f"expected {EXPECTED}"):
                file = reading(path)
                arrays = checked(path, file)
            self._files[shard] = file, arrays
            if shard and (kinds := self._kinds_of(shard)) != self._kinds:
                raise Refused(f"{path}: expected arrays {self._kinds}, got {kinds}")
            while len(self._files) > OPEN:
                self._files.popitem(last=False)[1][0].close()
        self._files.move_to_end(shard)
        return self._files[shard][1]

    def _kinds_of(self, shard: int) -> dict[str, tuple[int, ...]]:
        arrays = self._arrays(shard)
        return {name: array.shape[1:] for name, array in arrays.items()}


def write_view(
    path: str | Path, events: str | Path, item: int, raw: str = "backprojection"
) -> None:
    """Write a file for pytorch-3dunet whose `raw` and `label` refer to an event in a file of
    events, without copying values (HDF5 virtual datasets); the label is the truth.

    Args:
        path: path of the new file, which refers to the other by a relative path.
        events: a file of `mvrecon_spect.events`.
        item: index of the event in the file.
        raw: an array on the truth's voxels, "backprojection" or a map.

    Raises:
        Refused: not a file of events, no such event, or an array on another grid.
    """
    events = Path(events).resolve()
    _, count = header_of(events)
    with opened(events, "a file of events") as file:
        parts = {"raw": raw, "label": "truth"}
        shapes = {key: dataset_in(events, file, name, raw).shape for key, name in parts.items()}
    if not 0 <= item < count or shapes["raw"] != shapes["label"]:
        raise Refused(
            f"{events}: expected an event below {count} and an array of shape {shapes['label']}, "
            f"got {item} and {raw} {shapes['raw']}"
        )
    way = os.path.relpath(events, Path(path).resolve().parent)
    with written_whole(path) as part, h5py.File(part, "w", libver=FORMAT) as file:
        for name, array in (("raw", raw), ("label", "truth")):
            layout = h5py.VirtualLayout(shapes[name][1:], "f4")
            layout[:] = h5py.VirtualSource(way, array, shapes[name], "f4")[item]
            file.create_virtual_dataset(name, layout)
