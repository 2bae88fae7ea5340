"""What a volume file must say of itself: attributes and names."""

from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path

import h5py

from mvrecon.data.attenuation import UNITS
from mvrecon.data.texts import texts_of, variable
from mvrecon.files.checks import Refused, shown

#: Attributes of every file with the texts that they may be; those of some.
LAYOUT = {"axes": ("z, y, x",), "units": UNITS}
OPTIONAL = ("orientation", "labels")
Texts = dict[str, list[str]]
EXPECTED = (
    "an mvrecon volume file: HDF5 with datasets ct [n d h w] in HU (or 1/mm, activity), spacing "
    "[n 3] in mm, id [n], axes z, y, x"
)


def check_layout(path: Path | str, attributes: Mapping[str, str | None]) -> None:
    """Check the attributes that every file has.

    Raises:
        Refused: other axes or units.
    """
    if any(attributes[key] not in values for key, values in LAYOUT.items()):
        got = {key: attributes[key] for key in LAYOUT}
        raise Refused(f"{path}: has the attributes {shown(got)}, expected {LAYOUT}: {EXPECTED}")


def check_names(path: Path | str, names: Sequence[str]) -> None:
    """Check that every volume has a name of its own.

    Raises:
        Refused: two volumes of one name.
    """
    if doubled := [name for name, count in Counter(names).items() if count > 1]:
        raise Refused(
            f"{path}: has several volumes of the name {shown(doubled)}; expected every name once"
        )


def attributes_and_names(path: Path, file: h5py.File, names: h5py.Dataset) -> Texts:
    """The attributes that are read, under "@<name>", and the names of the volumes.

    Raises:
        Refused: an attribute that is no short text.
    """
    kinds = {key: file.attrs.get_id(key) for key in (*LAYOUT, *OPTIONAL) if key in file.attrs}
    for key, kind in kinds.items():
        if (
            kind.shape != ()
            or h5py.check_string_dtype(kind.dtype) is None
            or kind.dtype.itemsize > 2**16
        ):
            raise Refused(
                f"{path}: its attribute {key!r} is {kind.dtype} {kind.shape}, expected one short "
                f"text"
            )
    short = [key for key, kind in kinds.items() if not variable(kind.dtype)]
    fixed = {key: [bytes(file.attrs[key]).decode()] for key in short}  # type: ignore[arg-type]
    texts = texts_of(path) if len(fixed) < len(kinds) or variable(names.dtype) else {}
    if not variable(names.dtype):
        texts["id"] = [name.decode() for name in names[:]]
    return {**texts, **{f"@{key}": value for key, value in fixed.items()}}
