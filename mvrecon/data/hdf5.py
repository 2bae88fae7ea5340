"""Volume files: CT volumes of one shape in one HDF5 file, axes z, y, x.

    ct        [n d h w]  Hounsfield units, any integer or float type; one compressed chunk a volume
    spacing   [n 3]      mm between voxels along z, y, x
    id        [n]        name of each volume, UTF-8
    label     [n d h w]  optional, uint8: structures, 0 outside all of them; not read by the scenes

Attributes of the file: `axes` = "z, y, x" and `units` = "HU"; optional `orientation`, three letters that say towards
which side of the patient (L or R, P or A, I or S) the axes x, y, z run; others (`labels`, `source`) are for the reader.
"""

import os
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np

LAYOUT = {"axes": "z, y, x", "units": "HU"}
EXPECTED = "an mvrecon volume file: HDF5 with datasets ct [n d h w] in HU, spacing [n 3] in mm, id [n], axes z, y, x"


@dataclass(frozen=True, eq=False)
class Stored:
    """One volume of a file.

    Args:
        name: of the volume.
        ct: Hounsfield units [d h w].
        spacing: mm along (z, y, x).
        label: structures [d h w], or none.
    """

    name: str
    ct: np.ndarray
    spacing: tuple[float, float, float]
    label: np.ndarray | None = None


@contextmanager
def written_whole(path: str | Path) -> Iterator[Path]:
    """A temporary path beside `path` that takes its place once all is written: a crash leaves what was there before.

    The contents reach the disk before the name does, so that a loss of power cannot leave half a file either.
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        yield part
        _flush(part, os.O_RDWR)
        os.replace(part, path)
        if os.name == "posix":
            _flush(path.parent, os.O_RDONLY)
    finally:
        part.unlink(missing_ok=True)


def _flush(path: Path, flags: int) -> None:
    descriptor = os.open(path, flags)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def write_volumes(path: str | Path, volumes: Iterable[Stored], **attributes: str) -> int:
    """Write a volume file whole, or not at all; returns how many volumes it holds. `attributes` go with the file.

    Raises:
        ValueError: volumes of different shapes, only some with labels, or none.
    """
    count = 0
    with written_whole(path) as part, h5py.File(part, "w") as file:
        file.attrs.update({**LAYOUT, **attributes})
        for count, volume in enumerate(volumes, start=1):  # noqa: B007 (counted for the caller)
            arrays = {"ct": volume.ct} | ({} if volume.label is None else {"label": volume.label})
            if count == 1:
                _create(file, arrays)
            found = {name: array.shape for name, array in arrays.items()}
            expected = {name: file[name].shape[1:] for name in ("ct", "label") if name in file}  # type: ignore[union-attr]
            if found != expected:
                raise ValueError(f"{path}: volume {volume.name!r} has {found}, expected {expected} as the first")
            for name, array in {**arrays, "spacing": volume.spacing, "id": volume.name}.items():
                dataset: Any = file[name]
                dataset.resize(count, axis=0)
                dataset[count - 1] = array
        if not count:
            raise ValueError(f"{path}: expected at least one volume to write, got none")
    return count


def _create(file: h5py.File, arrays: Mapping[str, np.ndarray]) -> None:
    for name, array in arrays.items():
        chunks = {"chunks": (1, *array.shape), "maxshape": (None, *array.shape)}
        file.create_dataset(
            name, (0, *array.shape), array.dtype, **chunks, compression="gzip", compression_opts=9, shuffle=True
        )
    file.create_dataset("spacing", (0, 3), "f8", maxshape=(None, 3))
    file.create_dataset("id", (0,), h5py.string_dtype(), maxshape=(None,))


class VolumeFile:
    """A volume file for reading. It is opened at first use, anew in every process, and travels by its path alone.

    Args:
        path: of the file.
    """

    def __init__(self, path: str | Path):
        self.path = Path(path)
        self._open: tuple[int, h5py.File] | None = None

    def __getstate__(self) -> dict[str, Any]:
        return {"path": self.path, "_open": None}

    @property
    def file(self) -> h5py.File:
        """The open file, checked.

        Raises:
            FileNotFoundError: nothing is there.
            ValueError: not HDF5, cut short, of another layout, or leading to other files.
        """
        if self._open is None or self._open[0] != os.getpid():
            self._open = (os.getpid(), _opened(self.path))
        return self._open[1]

    def __len__(self) -> int:
        return len(_dataset(self.path, self.file, "ct"))

    @property
    def orientation(self) -> str | None:
        """Towards which sides of the patient the axes x, y, z run; none where the file does not say."""
        return self.file.attrs.get("orientation")

    def read(self, index: int) -> Stored:
        """One volume, without its labels.

        Raises:
            ValueError: its bytes cannot be read.
        """
        try:
            ct, spacing, name = (_dataset(self.path, self.file, key)[index] for key in ("ct", "spacing", "id"))
        except OSError as error:
            raise ValueError(
                f"{self.path}: volume {index} cannot be read ({error}); is the file cut short or damaged?"
            ) from error
        return Stored(name.decode(), ct, tuple(spacing.tolist()))


def _opened(path: Path) -> h5py.File:
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file; expected {EXPECTED}")
    if not h5py.is_hdf5(path):
        raise ValueError(f"{path}: not an HDF5 file; expected {EXPECTED}")
    try:
        file = h5py.File(path, "r", locking="best-effort")
    except OSError as error:
        raise ValueError(f"{path}: cannot be opened ({error}); is it cut short? Expected {EXPECTED}") from error
    try:
        _check(path, file)
    except Exception:
        file.close()
        raise
    return file


def _check(path: Path, file: h5py.File) -> None:
    wrong = {key: file.attrs.get(key) for key, value in LAYOUT.items() if file.attrs.get(key) != value}
    if wrong:
        raise ValueError(f"{path}: has the attributes {wrong}, expected {LAYOUT}: {EXPECTED}")
    ct, spacing, names = (_dataset(path, file, key) for key in ("ct", "spacing", "id"))
    shapes = {"ct": ct.shape, "spacing": spacing.shape, "id": names.shape}
    if ct.ndim != 4 or 0 in ct.shape or spacing.shape != (len(ct), 3) or names.shape != (len(ct),):
        raise ValueError(f"{path}: has {shapes}; expected {EXPECTED}")
    if ct.dtype.kind not in "iuf" or spacing.dtype.kind != "f" or h5py.check_string_dtype(names.dtype) is None:
        kinds = f"ct {ct.dtype}, spacing {spacing.dtype}, id {names.dtype}"
        raise ValueError(f"{path}: has {kinds}; expected numbers, floats and text")
    bad = ~((spacing[:] > 0) & np.isfinite(spacing[:])).all(axis=1)
    if bad.any():
        first = int(bad.argmax())
        raise ValueError(f"{path}: volume {first} has the spacing {spacing[first].tolist()}, expected positive mm")


def _dataset(path: Path, file: h5py.File, name: str) -> h5py.Dataset:
    """A dataset whose bytes lie in this very file: a downloaded file must not read others of the user's."""
    link = file.get(name, getlink=True)
    if link is None:
        raise ValueError(f"{path}: has no dataset {name!r}, only {sorted(file)}; expected {EXPECTED}")
    dataset = file[name] if isinstance(link, h5py.HardLink) else None
    if not isinstance(dataset, h5py.Dataset) or dataset.is_virtual or dataset.external:
        raise ValueError(f"{path}: {name!r} is a link, a group or stored elsewhere; expected a dataset in the file")
    return dataset
