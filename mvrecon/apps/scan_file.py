"""`scan.yaml`: what describes a scan, its views and its geometry, in one file beside them.

`mvrecon-simulate` writes it, and a calibration writes `<volume>.scan.yaml` with the rig that it
found; `mvrecon-reconstruct scan=FOLDER`, or `scan=FILE`, takes it as if it were typed. An example::

    views: {path: projections, flip_rows: true}
    camera: {name: circular, sid: 400, sdd: 800, arc_degrees: 360, detector: {pixel_mm: 0.4}}
"""

import os
import re
import warnings
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import fields
from functools import partial
from pathlib import Path
from typing import Any

import yaml

from mvrecon.apps.config.grammar import as_text
from mvrecon.apps.settings import ReconstructSettings
from mvrecon.core.files.atomic import write_text
from mvrecon.core.files.checks import MAX_YAML_BYTES, Refused, file_in, from_home, text_of, yaml_of
from mvrecon.core.options import with_paths
from mvrecon.core.parts import VIEW_FILES
from mvrecon.core.quantities import FILE_MARK, INSIDE_MARK
from mvrecon.core.registry import hint

NAME, KEY = "scan.yaml", "scan"
#: The sections of the file: those of `mvrecon-reconstruct` that a scan determines.
SECTIONS = ("views", "camera", "projector", "grid")
#: Options whose texts may have any characters except control characters, as names of data sets.
TEXTS = ("views.pattern", "views.dataset")
#: Values: numbers, words, products of names or patterns of them, and paths; nothing that refers.
WORD, NAMED = re.compile(r"[\w.+*?/-]+( [*] [\w./-]+)*"), re.compile(r"[\w.+/: -]+")
#: Texts that are numbers where an option takes them, unless they are names of files.
NUMBER = re.compile(r"[-+]?((0|[1-9][0-9]*)(\.[0-9]*)?|\.[0-9]+)([eE][-+]?[0-9]+)?")
#: What OmegaConf would resolve, outside of comments.
REFERS = re.compile(r"^[^#\n]*?(\$\{[^}\n]*\}?)", re.MULTILINE)


class AsTyped(yaml.SafeLoader):
    """Reads numbers and dates as texts: names of files and data sets may look like these."""


class Unquoted(str):
    """What YAML takes for a number or a date, as it is typed."""


for kind in ("int", "float", "timestamp"):
    AsTyped.add_constructor(f"tag:yaml.org,2002:{kind}", lambda _, node: Unquoted(node.value))


def save(file: Path, description: Mapping[str, Mapping[str, Any] | None]) -> None:
    """Write the description of a scan; sections of None are left out, and paths, which begin in the
    working folder, are written as they begin in the file's.
    """
    told = {key: dict(value) for key, value in description.items() if value is not None}
    told = with_paths(told, ReconstructSettings, partial(_from_folder, file.parent))
    write_text(file, yaml.safe_dump(told, sort_keys=False))


def _from_folder(folder: Path, path: str, marks: tuple) -> str:
    """A path as it begins in a folder: of a file, or of a data set as <file>:<name>; the name of a
    data set alone, which is no file, begins at the root.
    """
    whole, (head, sign, name) = from_home(path), str(path).rpartition(":")
    there = whole.is_file() if FILE_MARK in marks else whole.exists()
    if not there and not sign:
        return _from_root(path)
    place, rest = (whole, "") if there else (from_home(head), sign + name)
    return os.path.relpath(place.resolve(), folder.resolve()) + rest


def _from_root(name: str) -> str:
    """The name of a data set that is no file, of any folder in which it is read."""
    return f"/{name.lstrip('/')}"


def expanded(arguments: Sequence[str]) -> list[str]:
    """A command line with the settings of its scan in the place of `scan=FOLDER`, before all
    others, which therefore win; a part, or a grid, that it chooses replaces that of the scan.

    Raises:
        FileNotFoundError: no description is there.
        LookupError: a setting that is none, and nearest to `scan`.
        Refused: several, or one with other sections or values.
    """
    places, rest = [], []
    known = {KEY, *(setting.name for setting in fields(ReconstructSettings))}
    for word in arguments:
        key, sign, value = word.partition("=")
        if sign and key.lstrip("+") == KEY:
            places.append(value[1:-1] if value[:1] in "'\"" and value[-1:] == value[:1] else value)
            continue
        if key.isidentifier() and f"mean {KEY!r}" in (nearest := hint(key, known)):
            raise LookupError(f"There is no setting {key!r}{nearest}")
        rest.append(word)
    if len(places) > 1 or "" in places:
        raise Refused(f"Expected scan=FOLDER once, got {' '.join(f'scan={p}' for p in places)}")
    typed = {word.partition("=")[0].lstrip("+~") for word in rest}
    own = typed | ({"grid"} if any(key.startswith("grid.") for key in typed) else set())
    told = [word for place in places for word in _settings(_found(from_home(place)))]
    return [word for word in told if re.split(r"[.=]", word)[0] not in own] + rest


def _found(place: Path) -> Path:
    """The description at a place: a file, or in a folder its own, that of its only calibration, or
    that of the only case of a simulation.
    """
    if place.is_file():
        return place
    if (place / NAME).is_file():
        return place / NAME
    found = sorted(place.glob(f"*.{NAME}")) + sorted(place.glob(f"cases/*/{NAME}"))
    if len(found) > 1:
        names = ", ".join(str(file) for file in found[:3])
        raise Refused(f"{place}: expected one {NAME}, got {len(found)}: {names}")
    if not found:
        raise FileNotFoundError(f"{place}: no {NAME} is there")
    return found[0]


def _settings(file: Path) -> Iterator[str]:
    """The lines of a command line that a file stands for; its paths begin in its folder."""
    if refers := REFERS.search(text_of(file, MAX_YAML_BYTES)):
        raise Refused(
            f"{file}: expected plain values, got {refers[1]}, which is not resolved in {NAME}; "
            f"write what it stands for, paths as they begin in its folder"
        )
    told = yaml_of(file, AsTyped)
    if not isinstance(told, dict) or not all(isinstance(part, dict) for part in told.values()):
        raise Refused(f"{file}: expected sections such as views: {{path: projections}}")
    if unknown := sorted(map(str, set(told) - set(SECTIONS))):
        raise Refused(f"{file}: no section is {unknown[0]!r}{hint(unknown[0], SECTIONS)}")
    if "camera" in told:
        told["camera"] = {"name": "from_file"} | told["camera"]

    views = told.get("views", {}).get("path")
    ending = Path(str(views).partition(":/")[0]).suffix.lower().lstrip(".")
    hdf5 = ending in VIEW_FILES.names() and VIEW_FILES.takes(ending, "angles")

    def from_file(path: str, marks: tuple) -> str | Path:
        found = file_in(file.parent, path, FILE_MARK not in marks) if path else None
        number = NUMBER.fullmatch(path) and any(kind in marks for kind in (int, float))
        if number and found and isinstance(path, Unquoted):
            warnings.warn(
                f"{file}: {path} is taken for a number, not for what is beside it by this name; "
                f"'{path}' in quotes is that",
                stacklevel=2,
            )
            return str(float(path))  # which is no name here, of which the command line would warn
        if found is not None:
            return found
        if number or not path:
            return path
        inside = INSIDE_MARK in marks and (hdf5 or views is None)
        named = inside and path[:1] not in (".", "~") and ":" not in path
        return _from_root(path) if named else file.parent / from_home(path)

    told = with_paths(told, ReconstructSettings, from_file)
    for section, options in told.items():
        if (name := options.pop("name", "from_file")) != "from_file":
            yield f"{section}={_word(file, section, name)}"
        yield from _lines(file, section, options)


def _lines(file: Path, key: str, value: Any) -> Iterator[str]:
    """The settings of a value; those of a mapping are its entries'."""
    if not isinstance(value, dict):
        yield f"{key}={_word(file, key, value)}"
        return
    for name, inner in value.items():
        if not str(name).isidentifier():
            raise Refused(f"{file}: expected names of settings in {key}, got {name!r}")
        yield from _lines(file, f"{key}.{name}", inner)


def _word(file: Path, key: str, value: Any) -> str:
    """A value as on a command line."""
    if isinstance(value, list):
        return f"[{','.join(_word(file, key, inner) for inner in value)}]"
    if isinstance(value, Path):
        told = str(value).removeprefix(f"{file.parent.absolute()}/").removeprefix(f"{file.parent}/")
        inside = told.isprintable() and file_in(file.parent, str(value)) is not None
        if "${" not in told and (value.exists() or inside or NAMED.fullmatch(told)):
            return str(value.absolute())
    elif value is None or isinstance(value, bool):
        return "null" if value is None else str(value).lower()
    elif key in TEXTS or (key.startswith("views.") and value[:1] == "/"):
        if value.isprintable() and "${" not in value:
            return as_text(value)
    elif WORD.fullmatch(str(value)):
        return str(value)
    raise Refused(f"{file}: expected a number, a word or a file as {key}, got {str(value)!r}")
