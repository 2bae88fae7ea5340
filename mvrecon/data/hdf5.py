"""Volume files: CT volumes of one shape in one HDF5 file, axes z, y, x.

    ct        [n d h w]  values in `units`, any integer or float type; compressed chunks of planes,
    of up to 32 MiB spacing   [n 3]      mm between voxels along z, y, x
    id        [n]        name of each volume, UTF-8, of fixed length; one that can be a file's, and
    no other's label     [n d h w]  optional, uint8: structures, 0 outside all of them; not read by
    the scenes

Attributes of the file: `axes` = "z, y, x" and `units` = "HU", "1/mm" or "activity"; optional
`orientation`, three letters for the side of the patient (L or R, P or A, I or S) towards which the
axes x, y, z run, and `labels`, names of the structures such as "1=Brainstem,2=SpinalCord"; others
(`source`) are informative.

mvrecon writes checksums of every chunk and of the layout (the format of HDF5 1.10), so that damage
is detected; files of other origin may have none.
"""

import math
import os
import re
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import torch

from mvrecon.core.files import checks
from mvrecon.core.files.atomic import written_whole
from mvrecon.core.files.keys import warn_of_unknown
from mvrecon.data.attenuation import UNITS, StoredUnit
from mvrecon.data.linked import VOLUME_AXES, Place, check_order, texts_at, unknown_attributes
from mvrecon.data.resample import Slab, Slabs, planes
from mvrecon.data.storage import (
    FORMAT,
    check_attributes,
    check_chunks,
    dataset_in,
    reading,
    unknown_members,
)
from mvrecon.data.texts import texts_of, variable

#: Attributes with their allowed texts, None where one may be missing; others that are read.
CHECKED_ATTRIBUTES = {
    "axes": ("z, y, x",),
    "units": UNITS,
    "spacing_units": (None, "mm", "mm, order z, y, x"),
}
OPTIONAL_ATTRIBUTES = ("orientation", "labels")
DATA_SETS = ("ct", "spacing", "id", "label")
Texts = dict[str, list[str]]
EXPECTED = (
    "an mvrecon volume file: HDF5 with datasets ct [n d h w] in HU (or 1/mm, activity), spacing "
    "[n 3] in mm, id [n], axes z, y, x"
)


def check_texts(
    path: Path | str, attributes: Mapping[str, str | None], names: Sequence[str]
) -> None:
    """Check the attributes, and that names of volumes are unique.

    Raises:
        Refused: other axes, units or units of the spacing, two volumes of one name.
    """
    if any(attributes.get(key) not in values for key, values in CHECKED_ATTRIBUTES.items()):
        got = {key: attributes.get(key) for key in CHECKED_ATTRIBUTES}
        raise checks.Refused(
            f"{path}: has the attributes {checks.shown(got)}, expected {CHECKED_ATTRIBUTES}: "
            f"{EXPECTED}"
        )
    if doubled := [name for name, count in Counter(names).items() if count > 1]:
        raise checks.Refused(
            f"{path}: has several volumes named {checks.shown(doubled)}; expected every name once"
        )


def attributes_and_names(path: Path, file: h5py.File, names: h5py.Dataset) -> Texts:
    """Return the known attributes, under "@<name>", and the names of the volumes.

    Raises:
        Refused: an attribute that is not a short text.
    """
    kinds = {
        key: file.attrs.get_id(key)
        for key in (*CHECKED_ATTRIBUTES, *OPTIONAL_ATTRIBUTES)
        if key in file.attrs
    }
    for key, kind in kinds.items():
        if (
            kind.shape != ()
            or h5py.check_string_dtype(kind.dtype) is None
            or kind.dtype.itemsize > 2**16
        ):
            raise checks.Refused(
                f"{path}: its attribute {key!r} is {kind.dtype} {kind.shape}, expected one short "
                f"text"
            )
    short = [key for key, kind in kinds.items() if not variable(kind.dtype)]
    fixed = {key: [bytes(file.attrs[key]).decode()] for key in short}  # type: ignore[arg-type]
    texts = texts_of(path) if len(fixed) < len(kinds) or variable(names.dtype) else {}
    if not variable(names.dtype):
        texts["id"] = [name.decode() for name in names[:]]
    return {**texts, **{f"@{key}": value for key, value in fixed.items()}}


#: A label and the name of its structure.
NAMED_LABEL = re.compile(r"([1-9][0-9]{0,2})=([^=,]+)")


def structures_of(path: Path, text: str | None) -> dict[str, int]:
    """Return the label of each structure by its name, from a text such as
    "1=Brainstem,2=SpinalCord".

    Raises:
        Refused: no text, another form, labels above 255, or a repeated label or name.
    """
    entries = [NAMED_LABEL.fullmatch(entry.strip()) for entry in (text or "").split(",")]
    named = {entry[2]: int(entry[1]) for entry in entries if entry}
    if len(set(named.values())) < len(entries) or max(named.values()) > 255:
        raise checks.Refused(
            f"{path}: expected the attribute labels to name each structure once, such as "
            f"'1=Brainstem,2=SpinalCord' with labels from 1 to 255, got {checks.shown(text)}"
        )
    return named


#: Bytes of a chunk to write, unless one plane has more.
CHUNK_BYTES = 2**25
Spacing = tuple[float, float, float]


@dataclass(frozen=True, eq=False)
class Stored:
    """One volume of a file.

    Args:
        name: name of the volume.
        ct: values [d h w] in the file's `units`, such as HU.
        spacing: mm along (z, y, x).
        label: structures [d h w], or None.
    """

    name: str
    ct: np.ndarray
    spacing: Spacing
    label: np.ndarray | None = None


def write_volumes(path: str | Path, volumes: Iterable[Stored], **attributes: str) -> int:
    """Write a volume file atomically; returns the number of volumes. `attributes` are stored in the
    file; `units` defaults to "HU".

    Raises:
        ValueError: unknown units, values that are not numbers [d h w], a spacing beyond
            `checks.SPACING_MM`, volumes of different shapes, labels of some volumes only, no
            volume, or a name that is repeated or not a valid file name.
    """
    count, names = 0, []
    attributes = {"axes": "z, y, x", "units": "HU", **attributes}
    check_texts(path, attributes, [])
    with written_whole(path) as part, h5py.File(part, "w", libver=FORMAT) as file:
        for key, value in attributes.items():
            text = value.encode()
            file.attrs.create(key, text, dtype=h5py.string_dtype("utf-8", max(1, len(text))))
        for count, volume in enumerate(volumes, start=1):  # noqa: B007 (counted for the caller)
            arrays = {"ct": volume.ct} | ({} if volume.label is None else {"label": volume.label})
            _check_stored(path, volume)
            if count == 1:
                _create(file, arrays)
            shapes = {name: array.shape for name, array in arrays.items()}
            expected = {name: file[name].shape[1:] for name in ("ct", "label") if name in file}  # type: ignore[union-attr]
            if shapes != expected:
                raise ValueError(
                    f"{path}: volume {volume.name!r} has {shapes}, expected {expected} as the first"
                )
            for name, array in {
                **arrays,
                "spacing": volume.spacing,
                "id": checks.plain_name(volume.name, path),
            }.items():
                dataset: Any = file[name]
                dataset.resize(count, axis=0)
                dataset[count - 1] = array
            names.append(volume.name)
        if not count:
            raise ValueError(f"{path}: expected at least one volume to write, got none")
        check_texts(path, attributes, names)
    return count


def _check_stored(path: Path | str, volume: Stored) -> None:
    """Raise for a volume that `VolumeFile` would refuse."""
    kind, shape, (low, high) = volume.ct.dtype, volume.ct.shape, checks.SPACING_MM
    if kind.kind not in "iuf" or len(shape) != 3 or 0 in shape:
        raise ValueError(
            f"{path}: expected the volume {volume.name!r} as integers or floats [d h w], got "
            f"{kind} {shape}"
        )
    if len(volume.spacing) != 3 or not all(low <= mm <= high for mm in volume.spacing):
        raise ValueError(
            f"{path}: expected the spacing (z, y, x) of {volume.name!r} within {low} to {high} mm, "
            f"got {volume.spacing}"
        )


def _create(file: h5py.File, arrays: Mapping[str, np.ndarray]) -> None:
    for name, array in arrays.items():
        depth = min(array.shape[0], max(1, CHUNK_BYTES // array[0].nbytes))
        packed = {"compression": "gzip", "compression_opts": 9, "shuffle": True, "fletcher32": True}
        sizes = {"chunks": (1, depth, *array.shape[1:]), "maxshape": (None, *array.shape)}
        file.create_dataset(name, (0, *array.shape), array.dtype, **sizes, **packed)
    file.create_dataset("spacing", (0, 3), "f8", maxshape=(None, 3), fletcher32=True)
    file.create_dataset(
        "id",
        (0,),
        h5py.string_dtype("utf-8", checks.MAX_NAME_BYTES),
        maxshape=(None,),
        fletcher32=True,
    )


class VolumeFile:
    """A volume file for reading, opened at first use in every process; pickled by its path.

    Args:
        path: path of the file.
    """

    def __init__(self, path: str | Path):
        self.path = Path(path)
        self._open: tuple[int, h5py.File, Texts] | None = None
        self._sound: set[tuple[str, int]] = set()

    def __getstate__(self) -> dict[str, Any]:
        return {"path": self.path, "_open": None, "_sound": set()}

    @property
    def file(self) -> h5py.File:
        """The open file, checked.

        Raises:
            FileNotFoundError: nothing is there.
            ValueError: not HDF5, cut short, of another layout, or linked to other files.
        """
        return self._checked()[0]

    def _checked(self) -> tuple[h5py.File, Texts]:
        if self._open is None or self._open[0] != os.getpid():
            self._open, self._sound = (os.getpid(), *_opened(self.path)), set()
        return self._open[1:]

    def __len__(self) -> int:
        return len(self._dataset("ct"))

    def _dataset(self, name: str) -> h5py.Dataset:
        return dataset_in(self.path, self.file, name, EXPECTED)

    @property
    def unit(self) -> StoredUnit:
        """Unit of the values: HU, 1/mm or activity."""
        return self._checked()[1]["@units"][0]  # type: ignore[return-value]

    @property
    def orientation(self) -> str | None:
        """Sides of the patient towards which the axes x, y, z run; None if the file has none."""
        return self._attribute("orientation")

    @property
    def structures(self) -> dict[str, int]:
        """Label of each structure by its name.

        Raises:
            ValueError: missing or invalid names.
        """
        return structures_of(self.path, self._attribute("labels"))

    def _attribute(self, name: str) -> str | None:
        return next(iter(self._checked()[1].get(f"@{name}", [])), None)

    def read(self, index: int) -> Stored:
        """Read one volume into memory, without its labels.

        Raises:
            ValueError: it cannot be read, or its name is not a valid file name.
        """
        name, spacing = self._about(index)
        ct = self._dataset("ct")
        parts = np.empty(ct.shape[1:], ct.dtype)
        for first, part in self._parts(index):
            parts[first : first + len(part)] = part
        return Stored(name, parts, spacing)

    def slabs(self, index: int, dataset: str = "ct") -> tuple[str, Slabs, Spacing]:
        """Return name, values (or labels) and spacing (z, y, x) of a volume, read chunk by chunk at
        every pass.

        Raises:
            ValueError: an invalid name; no such dataset, or one of another shape; in a pass: it
                cannot be read.
        """
        name, spacing = self._about(index)
        shape, known = (self._dataset(key).shape for key in (dataset, "ct"))
        if shape != known:
            raise checks.Refused(f"{self.path}: expected {dataset} {known} as ct, got {shape}")
        shape = shape[1:]
        step = planes(math.prod(shape[1:]))

        def passes() -> Iterator[Slab]:
            for first, part in self._parts(index, dataset):
                for k in range(0, len(part), step):
                    yield first + k, torch.from_numpy(part[k : k + step].astype("float32"))

        return name, Slabs(shape, 0, passes), spacing

    def _about(self, index: int) -> tuple[str, Spacing]:
        names = self._checked()[1]["id"]
        with checks.file_errors(self.path, f"volume {index} cannot be read"):
            z, y, x = self._dataset("spacing")[index].tolist()
            return checks.plain_name(names[index], self.path), (z, y, x)

    def _parts(self, index: int, dataset: str = "ct") -> Iterator[tuple[int, np.ndarray]]:
        """Planes of a volume as stored, chunk by chunk, with the index of the first."""
        with checks.file_errors(self.path, f"volume {index} cannot be read"):
            values = self._dataset(dataset)
            if (dataset, index) not in self._sound:
                check_chunks(self.path, values, index)
                self._sound.add((dataset, index))
            depth = values.chunks[1] if values.chunks else 1
            step = max(depth, planes(math.prod(values.shape[2:])) // depth * depth)
            for first in range(0, values.shape[1], step):
                yield first, values[index, first : first + step]


def _opened(path: Path) -> tuple[h5py.File, Texts]:
    checks.check_file(path, EXPECTED)
    if not h5py.is_hdf5(path):
        raise checks.Refused(f"{path}: not an HDF5 file; expected {EXPECTED}")
    with checks.file_errors(path, "cannot be opened", f"is it cut short? Expected {EXPECTED}"):
        file = reading(path)
        try:
            return file, _check(path, file)
        except Exception:
            file.close()
            raise


def _check(path: Path, file: h5py.File) -> Texts:
    ct, spacing, names = (dataset_in(path, file, key, EXPECTED) for key in ("ct", "spacing", "id"))
    shapes = {"ct": ct.shape, "spacing": spacing.shape, "id": names.shape}
    if ct.ndim != 4 or 0 in ct.shape or spacing.shape != (len(ct), 3) or names.shape != (len(ct),):
        raise checks.Refused(f"{path}: has {shapes}; expected {EXPECTED}")
    if (
        ct.dtype.kind not in "iuf"
        or spacing.dtype.kind != "f"
        or h5py.check_string_dtype(names.dtype) is None
    ):
        kinds = f"ct {ct.dtype}, spacing {spacing.dtype}, id {names.dtype}"
        raise checks.Refused(f"{path}: has {kinds}; expected numbers, floats and text")
    check_attributes(path, file, (*CHECKED_ATTRIBUTES, *OPTIONAL_ATTRIBUTES))
    unknown = unknown_members(path, file, DATA_SETS)
    for dataset, known in (
        (ct, ("units",)),
        (spacing, ("units", "order")),
        (names, ()),
    ):
        check_attributes(path, dataset, known)
        unknown += unknown_attributes(Place(path, dataset.name), known)
    warn_of_unknown(path, unknown)
    check_order(Place(path, "/ct"), VOLUME_AXES, EXPECTED)
    check_order(Place(path, "/spacing"), VOLUME_AXES[1:], EXPECTED)
    for dataset in (spacing, names):
        check_chunks(path, dataset)
    texts = attributes_and_names(path, file, names)
    attributes = {key: next(iter(texts.get(f"@{key}", [])), None) for key in CHECKED_ATTRIBUTES}
    check_texts(path, attributes, texts["id"])
    for dataset, unit in ((ct, attributes["units"]), (spacing, "mm")):
        place = Place(path, dataset.name)
        if (got := texts_at([place], "units").get(place, unit)) != unit:
            raise checks.Refused(f"{place}: expected the units {unit}, got {checks.shown(got)}")
    mm = spacing[:]
    bad = ~((mm >= checks.SPACING_MM[0]) & (mm <= checks.SPACING_MM[1])).all(axis=1)
    if bad.any():
        first = int(bad.argmax())
        got = f"volume {first} has the spacing {mm[first].tolist()}"
        raise checks.Refused(
            f"{path}: {got}, expected positive mm from {checks.SPACING_MM[0]} to "
            f"{checks.SPACING_MM[1]}"
        )
    return texts
