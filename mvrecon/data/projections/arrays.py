"""Projections as one array: .npy, .mha, .mhd, .nrrd, and the views.h5 of `mvrecon-simulate`."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import h5py
import numpy as np

from mvrecon.core.files.checks import EDGE, Refused, check_file, file_errors
from mvrecon.data.hdf5 import reading
from mvrecon.data.itk import itk_image
from mvrecon.data.projections.stack import ProjectionStack
from mvrecon.data.storage import check_chunks, dataset_in

EXPECTED = "the views.h5 of mvrecon-simulate: a dataset views [m v u] of floats"


class NpyViews(ProjectionStack):
    """Views in a NumPy file [m v u], or one view [v u], of which the asked-for part is read.

    Args:
        path: of the file.

    Raises:
        FileNotFoundError: nothing is there.
        Refused: no such array, cut short, or one of Python objects.
    """

    def __init__(self, path: Path):
        check_file(path, "a NumPy array [m v u]")
        with file_errors(path, "cannot be read as a NumPy array"):
            self._array = np.lib.format.open_memmap(path, mode="r")
        if self._array.ndim == 2:
            self._array = self._array[None]
        if self._array.ndim != 3 or max(self._array.shape[1:]) > EDGE:
            raise Refused(f"{path}: expected an array [m v u], got {self._array.shape}")
        names = [f"{path.stem} {k}" for k in range(len(self._array))]
        super().__init__(path, names, self._array.shape[1:], self._array.dtype)

    def _block(self, first: int, last: int) -> np.ndarray:
        return self._array[first:last]


class ItkViews(ProjectionStack):
    """Views in an image of three axes (u, v, view), as RTK writes them; from MHA and MHD that are
    not packed, only the asked-for part is read.

    Args:
        path: of the file.

    Raises:
        ImportError, FileNotFoundError, Refused: see `mvrecon.data.itk.itk_image`.
    """

    def __init__(self, path: Path):
        self._image = itk_image(path)
        columns, rows, views = self._image.size
        names = [f"{path.stem} {k}" for k in range(views)]
        super().__init__(path, names, (rows, columns), self._image.dtype)
        affine = self._image.affine
        if not np.array_equal(affine[:2, [0, 1, 3]], np.eye(2, 3)):  # ITK's own where none was set
            self.affine = affine

    def _block(self, first: int, last: int) -> np.ndarray:
        return self._image.read(first, last)


class Hdf5Views(ProjectionStack):
    """Line integrals in a views.h5 as `mvrecon-simulate` writes it.

    Args:
        path: of the file.

    Raises:
        FileNotFoundError: nothing is there.
        Refused: not HDF5, another layout, cut short, or more declared than there is.
    """

    kind = "integrals"

    def __init__(self, path: Path):
        check_file(path, EXPECTED)
        self._sound: set[int] = set()
        with self._opened(path) as file:
            views = dataset_in(path, file, "views", EXPECTED)
            if views.ndim != 3 or views.dtype.kind != "f":
                raise Refused(f"{path}: has {views.dtype} {views.shape}; expected {EXPECTED}")
            unit = views.attrs.get("unit")
            self.unit = unit if isinstance(unit, str) else None
            names = [f"view {k}" for k in range(len(views))]
            super().__init__(path, names, views.shape[1:], views.dtype)

    @staticmethod
    @contextmanager
    def _opened(path: Path) -> Iterator[h5py.File]:
        with (
            file_errors(path, "cannot be opened", f"is it cut short? Expected {EXPECTED}"),
            reading(path) as file,
        ):
            yield file

    def _block(self, first: int, last: int) -> np.ndarray:
        with self._opened(self.path) as file:
            views = dataset_in(self.path, file, "views", EXPECTED)
            step = views.chunks[0] if views.chunks else last
            for index in range(first - first % step, last, step):
                if index not in self._sound:
                    check_chunks(self.path, views, index)
                    self._sound.add(index)
            return views[first:last]
