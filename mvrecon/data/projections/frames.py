"""Frames of an HDF5 file as views: those of one data set, or of the parts of a virtual one."""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import h5py
import numpy as np
import torch
from jaxtyping import Bool
from torch import Tensor

from mvrecon.core.files.checks import Refused
from mvrecon.data.dicom_image import same
from mvrecon.data.linked import (
    MAX_VALUES,
    UNITS,
    Place,
    beside,
    check_around,
    followed,
    numbers_at,
    units_of,
    unknown_around,
)
from mvrecon.data.projections.stack import VIEWS, ProjectionStack
from mvrecon.data.storage import check_attributes, check_chunks, dataset_in, opened

#: Attributes of frames by which areaDetector states their part of the detector.
REGION = ("NDArrayDimOffset", "NDArrayDimBinning", "NDArrayDimReverse")
#: `H5S_SEL_ALL` of HDF5: a whole data set.
SELECTS_ALL = 3


class Part(NamedTuple):
    """Frames of a virtual data set, and those of another data set that they are, by numbers."""

    frames: np.ndarray
    place: Place
    own: np.ndarray


class Frames:
    """Frames [n v u] of one data set, or of those that a virtual one consists of.

    Args:
        place: place of the data set; one image is one frame.
        folder: other files must be in it, or below.

    Raises:
        Refused: not frames, or virtual frames whose parts are missing or are no whole frames.
    """

    def __init__(self, place: Place, folder: Path):
        self.place, self._sound = place, set()
        with opened(place.path) as file:
            stored: Any = file[place.name]
            if not isinstance(stored, h5py.Dataset):
                raise Refused(f"{place}: expected a data set of frames, got a group")
            few = stored.ndim in (2, 3) and stored.shape[0] <= MAX_VALUES
            if not few or stored.dtype.kind not in "biuf":
                got = f"{stored.dtype} {stored.shape}"
                raise Refused(f"{place}: expected numbers [m v u] of frames, got {got}")
            self.shape = (1,) * (3 - stored.ndim) + stored.shape
            self.dtype = stored.dtype
            check_attributes(place.path, stored, (*UNITS, *REGION))
            check_around(place)
            whole = Part(np.arange(self.shape[0]), place, np.arange(self.shape[0]))
            virtual = stored.virtual_sources() if stored.is_virtual else None
            parts = [whole] if virtual is None else [self._part(one, folder) for one in virtual]
        numbers = np.concatenate([part.frames for part in parts])
        if not np.array_equal(np.sort(numbers), np.arange(self.shape[0])):
            raise Refused(
                f"{place}: expected parts with each of {self.shape[0]} frames once, got "
                f"{len(numbers)} of {len({*numbers.tolist()})}"
            )
        order = np.argsort(numbers)
        self.parts = [part.place for part in parts]
        self._part_of = np.repeat(np.arange(len(parts)), [len(p.frames) for p in parts])[order]
        self._own = np.concatenate([part.own for part in parts])[order]
        self.region = {name: self._common(name) for name in REGION}
        places = dict.fromkeys([place, *self.parts])
        self.unknown = [name for one in places for name in unknown_around(one)]
        self.units = units_of([*places])

    def _common(self, name: str) -> np.ndarray | None:
        """An attribute of the data set, and of those of its parts; None if they have none."""
        places = dict.fromkeys([self.place, *self.parts])
        stated = [numbers_at(place, name) for place in places]
        known = [numbers for numbers in stated if numbers is not None]
        if other := [numbers for numbers in known if not same(numbers, known[0])]:
            raise Refused(f"{self.place}: expected one {name}, got {known[0]} and {other[0]}")
        return known[0] if known else None

    def _part(self, source: Any, folder: Path) -> Part:
        """A part of a virtual data set."""
        path = self.place.path
        if source.file_name != ".":
            path = beside(path, source.file_name, self.place.name, folder)
        found = followed(path, source.dset_name, folder)
        if found is not None:
            with opened(found.path) as file:
                stored = dataset_in(found.path, file, found.name)
                check_attributes(found.path, stored, (*UNITS, *REGION))
                shape, fits = stored.shape, np.can_cast(stored.dtype, self.dtype)
            check_around(found)
            frames = _whole_frames(source.vspace, self.shape)
            own = _whole_frames(source.src_space, shape)
            same_size = len(shape) in (2, 3) and shape[-2:] == self.shape[1:]
            if fits and same_size and 0 < len(frames) == len(own):
                return Part(frames, found, own)
        raise Refused(
            f"{self.place}: expected virtual frames that are whole frames of other data sets, of a "
            f"type that {self.dtype} holds, got others of {path}:{source.dset_name}; h5repack "
            f"makes one file of them"
        )

    def read(self, numbers: np.ndarray) -> np.ndarray:
        """The frames of increasing numbers."""
        out = np.empty((len(numbers), *self.shape[1:]), self.dtype)
        part_of = self._part_of[numbers]
        for k in np.unique(part_of).tolist():
            place, inside = self.parts[k], np.flatnonzero(part_of == k)
            wanted = self._own[numbers[inside]]
            with opened(place.path) as file:
                stored = dataset_in(place.path, file, place.name)
                if stored.dtype.kind not in "biuf" or stored.shape[-2:] != self.shape[1:]:
                    got = f"{stored.dtype} {stored.shape}"
                    raise Refused(f"{place}: expected frames {self.shape[1:]}, got {got}")
                if stored.ndim == 2:
                    check_chunks(place.path, stored)
                    out[inside] = stored[()]
                    continue
                self._check(place, stored, wanted)
                breaks = np.flatnonzero(np.diff(wanted) != 1) + 1
                for run, target in zip(
                    np.split(wanted, breaks), np.split(inside, breaks), strict=True
                ):
                    out[target] = stored[run[0] : run[-1] + 1]
        return out

    def _check(self, place: Place, stored: h5py.Dataset, numbers: np.ndarray) -> None:
        """Check the chunks of frames that were not checked before."""
        step = stored.chunks[0] if stored.chunks else len(stored)
        for index in np.unique(numbers - numbers % step).tolist():
            if (place, index) not in self._sound:
                check_chunks(place.path, stored, index)
                self._sound.add((place, index))


def _whole_frames(space: Any, shape: tuple[int, ...]) -> np.ndarray:
    """Numbers of the frames [n v u], or of the one [v u], that a selection of HDF5 consists of;
    none if it is not regular, or if parts of frames are selected.
    """
    count = shape[0] if len(shape) == 3 else 1
    if space.get_select_type() == SELECTS_ALL:
        return np.arange(count)
    if not space.is_regular_hyperslab():
        return np.arange(0)
    numbers = np.arange(1)
    if len(shape) == 3:
        start, step, blocks, block = (of_axis[0] for of_axis in space.get_regular_hyperslab())
        if blocks * block > count:  # also without limits
            return np.arange(0)
        numbers = (start + step * np.arange(blocks)[:, None] + np.arange(block)).ravel()
    whole = space.get_select_npoints() == len(numbers) * math.prod(shape[-2:])
    return numbers if whole and numbers[-1] < count else np.arange(0)


class FrameViews(ProjectionStack):
    """Some frames of a data set.

    Args:
        frames: all frames of the data set.
        numbers: numbers of the frames that are views.
        fields: flat and dark fields.
        rig: the rig that the file states.
        scan: HDF5 file of the scan, see `ProjectionStack`.
        stated: exposure and beam of all frames by name, a text for each, "" if none is stated.
        marked: mask of bad pixels.
        top: greatest grey value, if less than that of the type.
        unknown: keys of the file that its reader does not know, besides attributes of the frames.
    """

    def __init__(
        self,
        frames: Frames,
        numbers: np.ndarray,
        fields: dict[str, ProjectionStack] | None = None,
        rig: dict[str, Any] | None = None,
        scan: Path | None = None,
        stated: Mapping[str, np.ndarray] | None = None,
        marked: np.ndarray | None = None,
        top: float | None = None,
        unknown: Sequence[str] = (),
    ):
        self._frames, self._numbers, self.scan = frames, numbers, scan
        names = [f"frame {k}" for k in numbers[: VIEWS + 1].tolist()]
        super().__init__(frames.place.path, names, frames.shape[1:], frames.dtype)
        self.fields, self.rig, self.detector = fields or {}, rig, frames.region
        self.stated = {name: texts[numbers].tolist() for name, texts in (stated or {}).items()}
        self.kept = np.isin(np.arange(frames.shape[0]), numbers)
        self._marked, self._top, self.unknown = marked, top, [*frames.unknown, *unknown]
        self.units = frames.units
        if "flat" in self.fields:
            self.kind = "intensities"

    @property
    def marked(self) -> Bool[Tensor, "v u"] | None:
        return None if self._marked is None else torch.from_numpy(self._marked)

    @property
    def top(self) -> float | None:
        tops = [top for top in (super().top, self._top) if top is not None]
        return min(tops, default=None)

    def _block(self, first: int, last: int) -> np.ndarray:
        return self._frames.read(self._numbers[first:last])
