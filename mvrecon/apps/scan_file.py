"""`scan.yaml`: what describes a scan, its views and its geometry, in one file beside them.

`mvrecon-simulate` writes it, and `mvrecon-reconstruct scan=FOLDER` takes it as if it were typed.
For example::

    views: {path: projections, flip_rows: true}
    camera: {name: circular, sid: 400, sdd: 800, arc_degrees: 360, detector: {pixel_mm: 0.4}}
"""

import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import yaml

from mvrecon.core.files.atomic import written_whole
from mvrecon.core.files.checks import Refused, yaml_of

NAME, SETTING = "scan.yaml", "scan="
#: The sections of the file: those of `mvrecon-reconstruct` that a scan determines.
SECTIONS = ("views", "camera", "projector", "grid")
#: Values other than names of files beside it: numbers and words, nothing that refers or computes.
PLAIN = re.compile(r"[\w.+/-]+")


def save(folder: Path, description: Mapping[str, Mapping[str, Any] | None]) -> None:
    """Write the description of a scan into its folder; sections of None are left out."""
    told = {key: dict(value) for key, value in description.items() if value is not None}
    with written_whole(folder / NAME) as part:
        part.write_text(yaml.safe_dump(told, sort_keys=False), encoding="utf-8")


def expanded(arguments: Sequence[str]) -> list[str]:
    """A command line with the settings of its scan in the place of `scan=FOLDER`, before all
    others, which therefore win; a part, or a grid, that it chooses replaces that of the scan.

    Raises:
        FileNotFoundError: no description is there.
        Refused: several, or one with other sections or values.
    """
    places = [word.removeprefix(SETTING) for word in arguments if word.startswith(SETTING)]
    rest = [word for word in arguments if not word.startswith(SETTING)]
    if len(places) > 1:
        raise Refused(f"Expected one scan=, got {len(places)}")
    typed = {word.partition("=")[0] for word in rest}
    own = typed | ({"grid"} if any(key.startswith("grid.") for key in typed) else set())
    told = [word for place in places for word in _settings(_found(Path(place)))]
    return [word for word in told if re.split(r"[.=]", word)[0] not in own] + rest


def _found(place: Path) -> Path:
    """The file: itself, in a folder, or that of the only case of a simulation."""
    place = place.expanduser()
    if place.is_file():
        return place
    here, cases = place / NAME, sorted(place.glob(f"cases/*/{NAME}"))
    if here.is_file() or len(cases) == 1:
        return here if here.is_file() else cases[0]
    if cases:
        names = ", ".join(str(case.parent) for case in cases[:3])
        raise Refused(f"{place}: expected one {NAME}, got those of {len(cases)} cases: {names}")
    raise FileNotFoundError(f"{place}: no {NAME} is there")


def _settings(file: Path) -> Iterator[str]:
    """The lines of a command line that a file stands for; names of files beside it are paths."""
    told = yaml_of(file)
    if not isinstance(told, dict) or not all(isinstance(part, dict) for part in told.values()):
        raise Refused(f"{file}: expected sections such as views: {{path: projections}}")
    if unknown := sorted(map(str, set(told) - set(SECTIONS))):
        raise Refused(f"{file}: expected {', '.join(SECTIONS)}, got {', '.join(unknown)}")
    for section, options in told.items():
        options = dict(options)
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
    if isinstance(value, str) and (file.parent / value).exists():
        return str((file.parent / value).absolute())
    if isinstance(value, list):
        return f"[{','.join(_word(file, key, inner) for inner in value)}]"
    text = (
        "null"
        if value is None
        else str(value).lower()
        if value is True or value is False
        else str(value)
    )
    if not isinstance(value, str | int | float | None) or not PLAIN.fullmatch(text):
        raise Refused(f"{file}: expected a number, a word or a file as {key}, got {value!r}")
    return text
