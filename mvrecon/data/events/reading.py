"""Events on disk as a data set for training: an item is read when it is asked for."""

import os
from bisect import bisect_right
from collections import OrderedDict
from collections.abc import Sequence
from itertools import accumulate
from pathlib import Path
from typing import Any

import h5py
import torch
from torch.utils.data import Dataset

from mvrecon.core.files.checks import Refused, file_errors
from mvrecon.core.registry import hint
from mvrecon.data.events.shards import EXPECTED, checked, header_of
from mvrecon.data.hdf5 import reading
from mvrecon.data.storage import check_chunks
from mvrecon.geometry.grid import Grid

#: Files that a process has open at most.
OPEN = 16


class Events(Dataset[dict[str, Any]]):
    """Events in the files of a folder, read one at a time, in whichever process asks.

    An item has, as float32 with a channel first, what `names` says of "truth", "backprojection",
    the scene's maps [1 d h w], "ideal", "counts" [1 m v u] and "radon" [1 a z s]; also "dose" and
    "pose" [k] (float64), "index". Columns of "pose": `columns`.

    Args:
        folder: of the files, or several that hold one series.
        names: of the arrays that are read.

    Raises:
        FileNotFoundError: no files of events.
        LookupError: arrays that the files do not have.
        Refused: a file that is none of events, or of another grid.
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
        """Where the voxels of the truth lie."""
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
                event[name] = _tensor(arrays[name][row])
            event["index"] = int(arrays["index"][row])
        return event

    def _reset(self) -> None:
        self._process = os.getpid()
        self._files: OrderedDict[int, tuple[h5py.File, dict[str, h5py.Dataset]]] = OrderedDict()
        self._sound: set[tuple[int, int, str]] = set()

    def _arrays(self, shard: int) -> dict[str, h5py.Dataset]:
        """The arrays of a file, which this process opens itself."""
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


def _tensor(values: Any) -> torch.Tensor:
    """Volumes, views and sinograms as float32 with a channel; numbers and lists as float64."""
    if values.ndim < 3:
        return torch.as_tensor(values, dtype=torch.float64)
    return torch.from_numpy(values.astype("float32", copy=False))[None]
