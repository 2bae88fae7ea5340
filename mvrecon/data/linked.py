"""Data sets of foreign HDF5 files whose links lead to other files of the same folder."""

import math
import re
from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

import h5py
import numpy as np

from mvrecon.core.files.checks import Refused, check_file
from mvrecon.core.files.keys import FREE_TEXT, Key, check_keys, has_effect, unknown_names
from mvrecon.core.files.prose import stated_effects
from mvrecon.data.storage import (
    check_attributes,
    check_chunks,
    check_fields,
    dataset_in,
    opened,
    value_in,
)
from mvrecon.data.texts import texts_of, variable

#: Most links that a name may follow, and groups of a file that are searched.
MAX_LINKS, MAX_GROUPS = 16, 2**14
#: Most texts, or numbers, of an attribute.
MAX_TEXTS = 16
#: Most values of a data set that is read whole, such as the angles.
MAX_VALUES = 2**20
#: The attribute by which a dimension scale states what it belongs to.
REFERENCES = "REFERENCE_LIST"
#: Attributes by which files state units.
UNITS = ("units", "unit")
#: Attributes of free text.
TEXTS = ("comment", "description", "long_name", "title", "label", "history")

#: Attributes of data sets besides those with a word of `EFFECTS`, which are refused; a warning
#: names all others.
ATTRIBUTES = (
    Key("DISPLAY_ORIGIN", "refused", "the first row is the upper one, as views.flip_rows", ("UL",)),
    Key("IMAGE_SUBCLASS", "refused", "grey values", ("IMAGE_GRAYSCALE",)),
    Key(
        "axes, *_indices, DIMENSION_LABELS, dim0, dim1, dim2, NDArrayDim*, transformation_type, "
        "vector, depends_on",
        "compared",
        "attributes of the frames and of the angles",
    ),
    Key(
        "NX_class, target, signal, primary, axis, interpretation, name, local_name, short_name, "
        "source, date, timestamp, start_time, "
        "end_time, creator, *version, *Version, NeXus_*, publisher, program, author, user, "
        "operator, facility, beamline, uncertainties, check_sum, default, default_slice, "
        "auxiliary_signals, SILX_style*, NDArrayNumDims, NDArrayColorMode, NDAttr*, image_nr_*, "
        "decimals, file_*, equipment_component",
        "ignored",
        "texts, links and plots of NeXus and areaDetector",
    ),
    Key(", ".join(TEXTS), "ignored", FREE_TEXT),
    Key(
        "shape, dtype, doc, data_type, dimension, num_pixels_?, num_channels",
        "ignored",
        "of the values as they are stored; the last four of CIL",
    ),
    Key(
        "CLASS, NAME, *VERSION, TITLE, FLAVOR, FILTERS, EXTDIM, REFERENCE_LIST, DIMENSION_LIST, "
        "IMAGE_*, INTERLACE_MODE, PALETTE, MATLAB_*, H5PATH, _Netcdf4*, _NC*, coordinates, "
        "standard_name, institution, references, Conventions, cell_methods, grid_mapping, "
        "actual_range",
        "ignored",
        "of HDF5, MATLAB and netCDF, and of the display",
    ),
)


class MissingFile(Refused):
    """A link leads to a file that is not there."""


class Place(NamedTuple):
    """A data set or group: its file, its name there by hard links alone, and the links that led to
    it.
    """

    path: Path
    name: str
    links: tuple["Place", ...] = ()

    def __str__(self) -> str:
        return f"{self.path}:{self.name}"


def followed(
    path: Path,
    name: str,
    folder: Path | None = None,
    links: tuple[Place, ...] = (),
) -> Place | None:
    """Follow the links of a name; None: there is nothing of this name.

    Soft links and links to other files are followed. As libhdf5 does, the other file is looked for
    at its path, relative to this file's folder, or else by its name beside this file.

    Args:
        path: path of the file.
        name: name in the file, such as "/entry/data/data".
        folder: other files must be in it, or below; None: that of `path`.
        links: the links that were followed before.

    Raises:
        MissingFile: another file that is not in the folder.
        Refused: not HDF5, too many links, or another kind of link.
    """
    folder = path.parent.resolve() if folder is None else folder
    parts, done = [part for part in name.split("/") if part not in ("", ".")], []
    with opened(path) as file:
        here: h5py.HLObject = file
        for k, part in enumerate(parts):
            link = here.get(part, getlink=True) if isinstance(here, h5py.Group) else None
            if link is None:
                return None
            if isinstance(link, h5py.HardLink):
                here = here[part]  # type: ignore[index]
                done.append(part)
                continue
            rest = "/".join(parts[k + 1 :])
            if len(links) == MAX_LINKS or not isinstance(link, h5py.SoftLink | h5py.ExternalLink):
                kind = type(link).__name__
                raise Refused(f"{path}: expected at most {MAX_LINKS} links for {name}, got {kind}")
            links = (*links, Place(path, f"/{'/'.join([*done, part])}"))
            if isinstance(link, h5py.ExternalLink):
                path = beside(path, link.filename, links[-1].name, folder)
                target = link.path
            else:
                own = "" if link.path.startswith("/") else "/".join(done)
                target = f"{own}/{link.path}"
            return followed(path, f"{target}/{rest}", folder, links)
    return Place(path, "/" + "/".join(done), links)


def beside(path: Path, other: str, name: str, folder: Path) -> Path:
    """The file to which the link `name` of a file leads.

    Raises:
        MissingFile: it is not in the folder.
    """
    for choice in (path.parent / other, path.parent / Path(other).name):
        real = choice.resolve()
        if real.is_relative_to(folder) and real.is_file():
            return real
    raise MissingFile(
        f"{path}: {name} is a link to {other}, which is not in the folder {folder}; put the file "
        f"there, as the scan was stored"
    )


def address(place: Place) -> tuple[Path, int]:
    """File and address of an object, equal for all of its names there."""
    with opened(place.path) as file:
        info = h5py.h5o.get_info(file[place.name].id)  # type: ignore[attr-defined]
        return place.path.resolve(), info.addr


def check_around(place: Place) -> None:
    """Check the groups in which a data set and the links to it are, as `check_attributes` does.

    Raises:
        Refused: an attribute of a group, or a field in it, that scales the data set; not the
            category of units that nxtomo writes to transformations (NX_TRANSFORMATION).
    """
    for group, part in _around(place):
        category = texts_at([group], "units").get(group, "").startswith("NX_")
        with opened(group.path) as file:
            check_attributes(group.path, file[group.name], UNITS if category else ())
            check_fields(group.path, file[group.name], part)


def _around(place: Place) -> Iterator[tuple[Place, str]]:
    """The groups in which a data set and the links to it are, outer ones first, with the names of
    their members that lead to it.
    """
    for path, name, _ in (place, *place.links):
        parts = name.strip("/").split("/")
        for k, part in enumerate(parts):
            yield Place(path, "/" + "/".join(parts[:k])), part


def unknown_around(place: Place) -> list[str]:
    """The unknown attributes of a data set and of the groups in which it and the links to it are;
    see `unknown_attributes`.
    """
    holders = dict.fromkeys([place, *(group for group, _ in _around(place))])
    return [name for one in holders for name in unknown_attributes(one)]


def unknown_attributes(place: Place, known: Sequence[str] = ()) -> list[str]:
    """The attributes of a data set or group that neither its reader nor `ATTRIBUTES` know, as
    <data set>@<name>, not those that are zero; and what its `TEXTS` state.

    Raises:
        Refused: one of `ATTRIBUTES` to refuse.
    """
    refused = [name for key in ATTRIBUTES if key.use == "refused" for name in key.names]
    texts = attributes_at((place, name) for name in (*refused, *TEXTS))
    check_keys(place.path, ATTRIBUTES, lambda name: texts.get((place, name)))
    with opened(place.path) as file:
        stored: Any = file[place.name]
        names = [
            name
            for name in stored.attrs
            if not has_effect(name, "") and value_in(stored, name, stored.attrs.get_id(name)) != 0
        ]
    own = place.name.rpartition("/")[2] or "/"
    unknown = [f"{own}@{name}" for name in unknown_names(names, ATTRIBUTES) if name not in known]
    free = [name for name in TEXTS if (place, name) in texts and name not in known]
    return unknown + stated_effects((f"{own}@{name}", texts[place, name]) for name in free)


def values_at(place: Place, known: tuple[str, ...] = ()) -> np.ndarray:
    """The numbers of a small data set.

    Args:
        place: place of the data set.
        known: attributes that the caller applies.

    Raises:
        Refused: not numbers, more than `MAX_VALUES`, damage, or an attribute that changes
            values.
    """
    with opened(place.path) as file:
        stored = dataset_in(place.path, file, place.name)
        if stored.dtype.kind not in "biuf" or not 0 < math.prod(stored.shape) <= MAX_VALUES:
            got = f"{stored.dtype} {stored.shape}"
            raise Refused(f"{place}: expected up to {MAX_VALUES} numbers, got {got}")
        check_attributes(place.path, stored, known)
        check_around(place)
        check_chunks(place.path, stored)
        return np.asarray(stored[()])


def numbers_at(place: Place, attribute: str) -> np.ndarray | None:
    """An attribute of a data set or group as a row of numbers, as MATLAB writes it [1 n] or [n 1];
    None if it has none.

    Raises:
        Refused: other values, or more than `MAX_TEXTS`.
    """
    with opened(place.path) as file:
        attributes: Any = file[place.name].attrs
        if attribute not in attributes:
            return None
        kind = attributes.get_id(attribute)
        count = 0 if kind.shape is None else math.prod(kind.shape)
        if kind.dtype.kind not in "iuf" or not 0 < count <= MAX_TEXTS:
            got = f"{kind.dtype} {kind.shape}"
            raise Refused(f"{place}: expected its {attribute} as numbers, got {got}")
        return np.ravel(attributes[attribute])


def texts_at(places: Sequence[Place], attribute: str) -> dict[Place, str]:
    """A text among the attributes of data sets or groups, or the texts that they are (""), where
    there is one; see `attributes_at`.
    """
    found = attributes_at((place, attribute) for place in places)
    return {place: text for (place, _), text in found.items()}


def attributes_at(wanted: Iterable[tuple[Place, str]]) -> dict[tuple[Place, str], str]:
    """Texts by their data set or group and attribute, or "" for the text that it is, where there is
    one: of several, joined by colons; of another type, its name. Those of variable length of a file
    are read by one process.
    """
    found: dict[tuple[Place, str], str] = {}
    unread: dict[Path, list[tuple[Place, str]]] = {}
    for place, attribute in wanted:
        with opened(place.path) as file:
            stored: Any = (
                file[place.name] if attribute else dataset_in(place.path, file, place.name)
            )
            if attribute and attribute not in stored.attrs:
                continue
            kind = stored.attrs.get_id(attribute) if attribute else stored
            text, count = h5py.check_string_dtype(kind.dtype), math.prod(kind.shape or ())
            if kind.shape is None:
                found[place, attribute] = ""
                continue
            if text is None or not 0 < count <= MAX_TEXTS or kind.dtype.itemsize > 2**16:
                found[place, attribute] = str(kind.dtype)
                continue
            if variable(kind.dtype):
                unread.setdefault(place.path, []).append((place, attribute))
                continue
            value = stored.attrs[attribute] if attribute else stored[()]
            texts = (text.decode("utf-8", "replace") for text in np.ravel(value))
            found[place, attribute] = ":".join(texts)
    for path, those in unread.items():
        names = {f"{place.name}@{attribute}": (place, attribute) for place, attribute in those}
        for name, texts in texts_of(path, *names).items():
            found[names[name]] = ":".join(texts)
    return found


def units_at(places: Sequence[Place]) -> dict[Place, str]:
    """The unit that each data set states by an attribute of `UNITS`, where there is one."""
    found = attributes_at((place, name) for place in places for name in UNITS)
    return {
        place: found[place, name]
        for name in UNITS[::-1]
        for place in places
        if (place, name) in found
    }


def units_of(places: Sequence[Place], names: Sequence[str] = UNITS) -> str:
    """The units that data sets state by attributes of these names, several joined by " or "; empty
    without one.
    """
    stated = {*attributes_at((place, name) for place in places for name in names).values()}
    return " or ".join(sorted(stated - {""}))


#: Words before and behind the name of an axis of a detector; other words before it, as in
#: sample_x, are those of a stage.
BEFORE = (
    "(?:(?:.*[_ .-])?(?:det(?:ector)?|cam(?:era)?|pix(?:el)?|px|image|img|frame|proj(?:ection)?|"
    "data|axis|dim|num|n)[_ .-]?)?"
)
BEHIND = "(?:[_ .-]?(?:pix(?:els?)?|px|axis|dim|index|coord(?:inate)?s?|mm|um))?"
#: Names of axes in their order: of frames, and of volumes.
VIEW_AXES = (
    r".*(theta|angle|rotation|frame|view|projection|camera|image).*",
    rf"{BEFORE}(y|v|rows?|height|vertical){BEHIND}",
    rf"{BEFORE}(x|u|col|columns?|cols|width|horizontal){BEHIND}",
)
VOLUME_AXES = ("n|index|volume|case|id", "z|d|depth", "y|h|rows?|height", "x|w|columns?|width")
#: The unit behind the name of an axis.
UNIT_OF_AXIS = re.compile(r"\s*[\[(/].*")
#: Short names of axes, which may stand in one word.
LETTERS = "nmtzyxdhwvu"


def check_order(place: Place, axes: Sequence[str], expected: str) -> None:
    """Check the axes that a data set, or a group of NXdata, states by DIMENSION_LABELS, `axes`,
    `order`, `<axis>_indices`, CIL's `dim0` and so on, or dimension scales; unknown names may be
    anywhere.

    Args:
        place: place of the data set or group.
        axes: patterns of the names of each axis.
        expected: what should be there, for messages.

    Raises:
        Refused: a name of an axis at another's place.
    """
    stated: list[tuple[str, int, str]] = []
    orders, sizes = ("DIMENSION_LABELS", "axes", "order"), [f"dim{n}" for n in range(len(axes))]
    texts = attributes_at((place, name) for name in (*orders, *sizes))
    for attribute in orders:
        text = texts.get((place, attribute), "").strip("[](){} ").lower()
        names = _names_of_axes(text, len(axes))
        if attribute == "order" and text and len(names) != len(axes):
            raise Refused(f"{place}: expected {expected}, got the order {text!r}; remove it")
        if len(names) == len(axes):
            stated += [(name, n, attribute) for n, name in enumerate(names)]
    cil = [texts.get((place, name), "").lower() for name in sizes]
    if all(cil):  # fewer are those of one image
        stated += [(name, n, f"dim{n}") for n, name in enumerate(cil)]
    with opened(place.path) as file:
        indices = [name for name in file[place.name].attrs if name.endswith("_indices")]
    for attribute in indices:
        found = numbers_at(place, attribute)
        if found is not None and len(found) == 1:
            stated.append((attribute.removesuffix("_indices").lower(), int(found[0]), attribute))
    stated += _scales(place)
    for stated_name, n, attribute in stated:
        name = UNIT_OF_AXIS.sub("", stated_name)
        known = [k for k, pattern in enumerate(axes) if re.fullmatch(pattern, name)]
        if known and known[-1] != n:
            raise Refused(
                f"{place}: expected {expected}, got the axis {name!r} at the place {n} by its "
                f"{attribute}; transpose the values, or correct it"
            )


def _names_of_axes(text: str, count: int) -> list[str]:
    """The names of so many axes in a text: its letters, or its words without quotes, by the first
    signs that part it into so many; else its parts.
    """
    if len(text) == count and {*text} <= {*LETTERS}:
        return [*text]
    names: list[str] = []
    for signs in (":", "[:,;|/*]", r"[:,;|/*\s]+"):
        names = [part.strip("[](){}'\" ") for part in re.split(signs, text)]
        if len(names) == count:
            break
    return names


def _scales(place: Place) -> list[tuple[str, int, str]]:
    """The names of the dimension scales of a data set in its group and those above it, each with
    its axis, by the references of these scales: the data set's own are of variable length, in whose
    reading libhdf5 trusts the file.
    """
    found: list[tuple[str, int, str]] = []
    with opened(place.path) as file:
        own: Any = file[place.name]
        for group in groups_above(place):
            holder = file[group.name]
            names = [*holder] if isinstance(holder, h5py.Group) else []
            links = {name: holder.get(name, getlink=True) for name in names}
            scales = [holder[name] for name in names if isinstance(links[name], h5py.HardLink)]
            for scale in scales:
                if not isinstance(scale, h5py.Dataset) or not scale.is_scale:
                    continue
                kind = scale.attrs.get_id(REFERENCES) if REFERENCES in scale.attrs else None
                if kind is None or kind.dtype.names is None or math.prod(kind.shape) > MAX_VALUES:
                    continue
                name = scale.name.rpartition("/")[2].lower()
                for target, axis in np.ravel(scale.attrs[REFERENCES]).tolist():
                    with suppress(KeyError, ValueError):  # data sets that were deleted
                        if file[target] == own:
                            found.append((name, int(axis), "dimension scales"))
    return found


def groups(file: h5py.File) -> Iterator[h5py.Group]:
    """All groups of a file by hard links, each once, outer ones first."""
    seen, waiting = set(), [file["/"]]
    while waiting:
        group = waiting.pop(0)
        if group.id in seen or not isinstance(group, h5py.Group):
            continue
        seen.add(group.id)  # equal for one object
        if len(seen) > MAX_GROUPS:
            raise Refused(f"{file.filename}: expected at most {MAX_GROUPS} groups, got more")
        yield group
        for name in group:
            if isinstance(group.get(name, getlink=True), h5py.HardLink):
                if group.get(name, getclass=True) is h5py.Group:
                    waiting.append(group[name])


def groups_of(names: Sequence[Place]) -> dict[Place, str]:
    """The groups in which data sets are, also by the links to them, with their names there."""
    found: dict[Place, str] = {}
    for place in names:
        for path, name, _ in (*place.links, place):
            group, _, own = name.rpartition("/")
            found.setdefault(Place(path, group or "/"), own)
    return found


def groups_above(group: Place) -> Iterator[Place]:
    """A group and those that it is in, up to the file's root."""
    parts = group.name.strip("/").split("/")
    return (Place(group.path, "/" + "/".join(parts[:k])) for k in range(len(parts), -1, -1))


def members(group: Place | None) -> list[str]:
    """Names of the members of a group; none of what is no group."""
    if group is None:
        return []
    with opened(group.path) as file:
        return [*found] if isinstance(found := file[group.name], h5py.Group) else []


def listing(path: Path, most: int = 12) -> str:
    """What a file contains: its data sets of several values, the largest first, and its links to
    other files.
    """
    check_file(path, "an HDF5 file")
    sizes: list[tuple[int, str]] = []
    with opened(path) as file:
        for group in groups(file):
            for name in group:
                link, where = group.get(name, getlink=True), f"{group.name.rstrip('/')}/{name}"
                if isinstance(link, h5py.ExternalLink):
                    sizes.append((2, f"{where} (in {link.filename})"))
                elif isinstance(link, h5py.HardLink):
                    if group.get(name, getclass=True) is h5py.Dataset:
                        stored = group[name]
                        if stored.shape and (count := math.prod(stored.shape)) > 1:
                            sizes.append((count, f"{where} {stored.shape} {stored.dtype}"))
    lines = [line for _, line in sorted(sizes, key=lambda pair: -pair[0])]
    more = [f"and {len(lines) - most} more"] if len(lines) > most else []
    return "; ".join([*lines[:most], *more]) or "nothing of several values"
