"""Views in a single array: .npy, images of ITK (.mha, .mhd, .nrrd), and the views.h5 of
`mvrecon-simulate`.
"""

import math
from pathlib import Path

import h5py
import numpy as np

from mvrecon.core.files.checks import EDGE, Refused, check_file, npy_array, shown
from mvrecon.data.attenuation import check_unit_of_views
from mvrecon.data.itk import itk_image
from mvrecon.data.linked import VIEW_AXES, Place, check_order, unknown_attributes
from mvrecon.data.projections.stack import ProjectionStack
from mvrecon.data.storage import (
    check_attributes,
    check_chunks,
    dataset_in,
    opened,
    unknown_members,
)

#: Attributes of the views in a views.h5, and their axes.
ATTRIBUTES = ("axes", "unit", "attenuated", "dose", "unit_per_dose", "duration")
AXES = "camera, v, u"
EXPECTED = "the views.h5 of mvrecon-simulate: a dataset views [m v u] of floats"


class NpyViews(ProjectionStack):
    """Views in a NumPy file [m v u], or one view [v u], read partially.

    Args:
        path: path of the file.

    Raises:
        FileNotFoundError: nothing is there.
        Refused: no such array, cut short, or one of Python objects.
    """

    def __init__(self, path: Path):
        self._array = npy_array(path)
        self._bytes = path.stat().st_size
        if self._array.ndim == 2:
            self._array = self._array[None]
        if self._array.ndim != 3 or max(self._array.shape[1:]) > EDGE:
            raise Refused(f"{path}: expected an array [m v u], got {self._array.shape}")
        names = [f"{path.stem} {k}" for k in range(len(self._array))]
        super().__init__(path, names, self._array.shape[1:], self._array.dtype)

    def _block(self, first: int, last: int) -> np.ndarray:
        if (got := self.path.stat().st_size) < self._bytes:  # else a bus error ends the process
            raise Refused(f"{self.path}: expected {self._bytes} bytes, as before, got {got}")
        return self._array[first:last]


class ItkViews(ProjectionStack):
    """Views in an image of three axes (u, v, view), as RTK writes them, or one view (u, v);
    uncompressed MHA and MHD are read partially.

    Args:
        path: path of the file.

    Raises:
        ImportError, FileNotFoundError, Refused: see `mvrecon.data.itk.itk_image`.
        Refused: columns that do not run along x, or rows that do not run along y.
    """

    def __init__(self, path: Path):
        self._image = itk_image(path, views=True)
        self.units = self._image.unit
        columns, rows, views = self._image.size
        names = [f"{path.stem} {k}" for k in range(views)]
        super().__init__(path, names, (rows, columns), self._image.dtype)
        affine = self._image.affine
        if not np.array_equal(affine[:2, [0, 1, 3]], np.eye(2, 3)):  # ITK's default
            self.affine = affine
            right, down = spacing = np.linalg.norm(affine[:3, :2], axis=0)
            if not np.allclose(affine[:3, :2], np.eye(3, 2) * spacing, atol=1e-6 * spacing.min()):
                raise Refused(
                    f"{path}: expected views with columns along x and rows along y, got the "
                    f"direction {(affine[:3, :2] / spacing).T.round(6).tolist()}"
                )
            self.pixel_mm = (float(down), float(right))

    def _block(self, first: int, last: int) -> np.ndarray:
        return self._image.read(first, last)


class Hdf5Views(ProjectionStack):
    """Line integrals, or counts with their dose, in a views.h5 as `mvrecon-simulate` writes it.

    Args:
        path: path of the file.

    Raises:
        FileNotFoundError: nothing is there.
        Refused: not HDF5, another layout, cut short, or declared larger than the file; counts
            without a positive dose.
    """

    kind = "integrals"

    def __init__(self, path: Path):
        check_file(path, EXPECTED)
        self._sound: set[int] = set()
        with opened(path, EXPECTED) as file:
            views = dataset_in(path, file, "views", EXPECTED)
            if views.ndim != 3 or views.dtype.kind != "f":
                raise Refused(f"{path}: has {views.dtype} {views.shape}; expected {EXPECTED}")
            check_attributes(path, views, ATTRIBUTES)
            check_attributes(path, file)
            check_order(Place(path, "/views"), VIEW_AXES, EXPECTED)
            self.unit = _text(path, views, "unit")
            self.attenuated = _truth(path, views, "attenuated")
            if (axes := _text(path, views, "axes")) not in (None, AXES):
                raise Refused(f"{path}: expected the axes {AXES!r} of views, got {shown(axes)}")
            if self.unit != "counts" and (got := {"dose", "unit_per_dose"} & {*views.attrs}):
                raise Refused(
                    f"{path}: expected a {sorted(got)[0]} of views in the unit 'counts' alone, got "
                    f"one of {shown(self.unit)}"
                )
            if self.unit == "counts":
                self.unit = _text(path, views, "unit_per_dose")
                self.dose = _positive(path, views, "dose")
                self.duration_s = _positive(path, views, "duration", required=False)
                if self.unit is None or " of " in self.unit:  # else of line integrals
                    self.kind = "counts"
            if self.unit is not None:
                check_unit_of_views(self.unit, f"{path}: ")
            self.unknown = unknown_members(path, file, ["views"])
            self.unknown += unknown_attributes(Place(path, "/views"), ATTRIBUTES)
            names = [f"view {k}" for k in range(len(views))]
            super().__init__(path, names, views.shape[1:], views.dtype)

    def _block(self, first: int, last: int) -> np.ndarray:
        with opened(self.path, EXPECTED) as file:
            views = dataset_in(self.path, file, "views", EXPECTED)
            step = views.chunks[0] if views.chunks else last
            for index in range(first - first % step, last, step):
                if index not in self._sound:
                    check_chunks(self.path, views, index)
                    self._sound.add(index)
            return views[first:last]


def _text(path: Path, views: h5py.Dataset, key: str) -> str | None:
    """A text among the attributes, of fixed or variable length."""
    value = views.attrs.get(key)
    value = value.decode() if isinstance(value, bytes) else value
    if value is not None and not isinstance(value, str):
        raise Refused(f"{path}: expected the {key} of views as text, got {shown(value)}")
    return value


def _truth(path: Path, views: h5py.Dataset, key: str) -> bool:
    """A truth value among the attributes; false if missing."""
    value = views.attrs.get(key, np.bool_(False))
    if not isinstance(value, np.bool_):
        raise Refused(f"{path}: expected {key} of views as true or false, got {shown(value)}")
    return bool(value)


def _positive(path: Path, views: h5py.Dataset, key: str, required: bool = True) -> float | None:
    """A positive number among the attributes of counts."""
    value = views.attrs.get(key)
    if value is None and not required:
        return None
    if not isinstance(value, int | float | np.number) or not 0 < value < math.inf:
        raise Refused(f"{path}: expected counts with a positive {key}, got {shown(value)}")
    return float(value)
