"""Checks of settings: the plain data of YAML against the types of options.

A mapping of options is recognised by its type: `PartOf` for a part's name and options, `OptionsOf`
for the keywords of a function or class, a `TypedDict`, or a dataclass of plain values.
"""

import json
import math
import re
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from pkgutil import resolve_name
from typing import Annotated, Any, Literal, NamedTuple, get_args, get_origin

from pydantic import ConfigDict, TypeAdapter, ValidationError

from mvrecon.core.files.checks import shown
from mvrecon.core.parts import LISTED, REGISTRIES, Options, describe
from mvrecon.core.quantities import NonNegativeFloat
from mvrecon.core.registry import check_options, hint
from mvrecon.core.signatures import (
    REQUIRED,
    TARGET_KEY,
    NamesOf,
    Option,
    OptionsOf,
    PartOf,
    alternatives,
    in_words,
    is_record,
    items,
    options_of,
    options_of_section,
    settable,
)

ANY_CLASS = ConfigDict(arbitrary_types_allowed=True)


class Section(NamedTuple):
    """A mapping of options within plain settings: where it is, the mark of its type or the record
    that is its type, the options that it may have, and whether it may have others.
    """

    path: str
    node: Options
    mark: Any
    options: Mapping[str, Option]
    catch_all: bool


def fits(value: Any, type: Any) -> bool:
    """Whether plain data have a type, as pydantic's strict mode decides for JSON: an int is a
    float, but neither a bool nor a text is a number. The entries of a mapping of options are not
    looked at.
    """
    members = alternatives(type)
    if isinstance(value, Mapping):
        return any(
            get_origin(member) in (Mapping, dict) or member in (Any, dict) or is_record(member)
            for member, _ in members
        )
    if value == "" and any(member is Path for member, _ in members):
        return False  # the current folder, as where a variable of the shell is not set
    return any(
        _is_plain(value, Annotated[member, *metadata] if metadata else member)
        for member, metadata in members
        if settable(member) and not is_record(member)
    )


def _is_plain(value: Any, type: Any) -> bool:
    if isinstance(value, float) and math.isnan(value):
        return False
    try:
        TypeAdapter(type, config=ANY_CLASS).validate_json(json.dumps(value), strict=True)
    except (ValidationError, TypeError):
        return False
    return True


def is_section(type: Any) -> bool:
    """Whether a type, or the entries of a mapping of it, have options."""
    pairs = alternatives(type)
    return has_entries(type) or any(_section(*pair) is not None for pair in pairs)


def has_entries(type: Any) -> bool:
    """Whether a type is of mappings by name whose entries have options."""
    return any(
        get_origin(member) in (Mapping, dict)
        and _section(member, metadata) is None
        and is_section(get_args(member)[1])
        for member, metadata in alternatives(type)
    )


def parts_in(value: Any, type: Any) -> list[tuple[str, str, Options]]:
    """All parts within plain data of a type, at any depth, outer ones first: path, kind and
    mapping.
    """
    found: list[Section] = []
    _mapped(value, type, at=found.append)
    return [(s.path, s.mark.kind, s.node) for s in found if isinstance(s.mark, PartOf)]


def _mapped(
    value: Any,
    type: Any,
    path: str = "",
    change: Callable[[Any, Any], Any] = lambda value, type: value,
    at: Callable[[Section], object] = lambda section: None,
) -> Any:
    """Plain data of a type with each value changed that holds no others; an empty mapping has
    nothing to check, nor to import.

    Args:
        value: data to be copied.
        type: its type.
        path: place of the value in the settings.
        change: f(value, type).
        at: f(section), called with each mapping of options first; true: it stays as it is.
    """
    for member, metadata in alternatives(type):
        mark, inner = _section(member, metadata), get_args(member)
        if isinstance(value, Mapping) and value and mark is not None:
            section = Section(path, value, mark, *_options(value, mark))
            if at(section):
                return value
            types = {key: section.options.get(key, Option()).type for key in value}
        elif isinstance(value, Mapping) and get_origin(member) in (Mapping, dict):
            types = dict.fromkeys(value, inner[1])
        elif isinstance(value, list) and get_origin(member) in (Sequence, list, tuple):
            pairs = enumerate(zip(value, items(member, len(value)), strict=False))
            return [_mapped(item, t, f"{path}.{n}", change, at) for n, (item, t) in pairs]
        else:
            continue
        return {
            key: _mapped(value[key], t, f"{path}.{key}".lstrip("."), change, at)
            for key, t in types.items()
        }
    return change(value, type)


def _section(member: Any, metadata: tuple[Any, ...]) -> Any:
    """What describes the options of a mapping of a type: a mark, or the record itself."""
    marks = [mark for mark in metadata if isinstance(mark, PartOf | OptionsOf | NamesOf)]
    if get_origin(member) is Mapping and marks:
        return marks[0]
    return member if is_record(member) else None


def _options(node: Options, section: Any) -> tuple[Mapping[str, Option], bool]:
    if isinstance(section, OptionsOf):
        return options_of_section(section)
    if isinstance(section, NamesOf):
        return {name: Option(NonNegativeFloat, 0.0) for name in LISTED[section.kind].names()}, False
    if not isinstance(section, PartOf):
        return options_of(section)
    own: dict[str, Option] = options_of(resolve_name(section.also))[0] if section.also else {}
    key, known = section.key_in(node), LISTED[section.kind]
    own[key], name = Option(str, None), node.get(key)
    if not isinstance(name, str) or later(name) or (key == "name" and name not in known.names()):
        return own, True
    if key == TARGET_KEY:
        options, catch_all = options_of(resolve_name(section.targets)(name))
    else:
        part = describe(section.kind, name)
        options, catch_all = part.options, part.catch_all or bool(part.error)
    passed = {key: option for key, option in options.items() if key not in section.supplied}
    return {**passed, **own}, catch_all


def check(settings: Options, type: Any, complete: bool = False) -> None:
    """Check plain settings: names of parts, names of options, and values of known type, range and
    length. Interpolated and missing values are not checked; a part that does not import raises when
    it is built.

    Args:
        settings: plain.
        type: a record of all settings.
        complete: also check that all settings are there, the names of parts that have options, and
            all options without a default.

    Raises:
        LookupError: an unknown name of a part; what is not there.
        TypeError: an unknown option, or a value of another type.
        PermissionError: a target that is not allowed.
    """
    found: list[Section] = []

    def one(section: Section) -> None:  # before the parts within it are imported
        found.append(section)
        path, node, options = section.path, section.node, section.options
        owner, key = path or "This app", ""
        if isinstance(section.mark, PartOf):
            owner, key = _check_name(path, node, section.mark), section.mark.key_in(node)
        if not section.catch_all:
            known = [k for k, o in options.items() if k != key and (k in node or settable(o.type))]
            check_options(owner, [k for k in node if k != key], known, path)
        for name, value in node.items():
            check_value(f"{path}.{name}".lstrip("."), value, options.get(name, Option()))

    _mapped(settings, type, at=one)
    for section in found if complete else ():
        whole, mark = section.mark is type, section.mark
        named = not isinstance(mark, PartOf) or mark.key_in(section.node) in section.node
        absent = [
            f"{section.path}.{key}=...".lstrip(".")
            for key, option in section.options.items()
            if section.node.get(key, "???" if whole else option.default) in ("???", REQUIRED)
            and (named or key in section.node)
        ]
        if isinstance(mark, PartOf) and not (named or mark.partial):
            absent.append(f"{section.path}.name=...")
        if absent:
            raise LookupError(f"These settings must be given: {', '.join(absent)}")


def check_value(path: str, value: Any, option: Option) -> None:
    """Check the plain value of an option; one that is interpolated or missing is not checked.

    Raises:
        TypeError: it has another type.
        LookupError: it is no name of a part.
    """
    if later(value):
        return
    mark = part_of(option.type)
    kind = mark.kind if mark else ""
    if isinstance(value, Mapping) and fits(value, option.type):
        named = value.get("name") or (mark and mark.partial and "name" not in value)
        if kind in REGISTRIES and "." in path and not named:
            raise TypeError(
                f"{path}.name: expected one of {', '.join(LISTED[kind].names())}, got null"
            )
        for member, metadata in alternatives(option.type):
            if get_origin(member) in (Mapping, dict) and _section(member, metadata) is None:
                for key, item in value.items():
                    check_value(f"{path}.{key}", item, Option(get_args(member)[1]))
        return
    if fits(value, option.type):
        if kind and isinstance(value, str) and value not in LISTED[kind].names():
            raise LookupError(f"{path}: no {kind} is {value!r}{hint(value, LISTED[kind].names())}")
        return
    text = f" ({option.text.rstrip('.')})" if option.text else ""
    if isinstance(value, str) and kind in REGISTRIES:
        text = f"; the command line chooses it by {kind}@{path}={value}"
    raise TypeError(
        f"{path}: expected {in_words(option.type)}, got "
        f"{'null' if value is None else shown(value)}{text}"
    )


def part_of(type: Any) -> PartOf | None:
    """The mark of a type that names parts; None for others."""
    marks = (mark for _, metadata in alternatives(type) for mark in metadata)
    return next((mark for mark in marks if isinstance(mark, PartOf)), None)


def _check_name(path: str, node: Options, section: PartOf) -> str:
    """Check the name of a part; returns its description for messages."""
    registry, key = LISTED[section.kind], section.key_in(node)
    name = node.get(key)
    if not isinstance(name, str) or later(name):
        return path  # options of a part that is named later, or no name, which is checked as a text
    if key == "name" and name not in registry.names():
        raise LookupError(
            f"{path}.name: no {section.kind} is {name!r}{hint(name, registry.names())}"
        )
    if section.classical and describe(section.kind, name).is_class:
        raise TypeError(f"{path}.name: expected a classical method, got the learned one {name!r}")
    return f"{path} (the {section.kind} {name.rpartition('.')[2]!r})"


def later(value: Any) -> bool:
    """Whether a setting is interpolated, or still missing."""
    return isinstance(value, str) and (value == "???" or "${" in value)


def with_paths(value: Any, type: Any, change: Callable[[str, tuple], str | Path]) -> Any:
    """Change every path within plain data of a type, but not those of callbacks and loggers, which
    are relative to the run's folder.

    A text is a path if the type has `Path`, unless it is one of the type's literals, or matches a
    pattern with which `Path` is annotated.

    Args:
        value: data to be copied.
        type: its type.
        change: f(path, marks): the path in its place; marks annotate its type, as `WEIGHTS_MARK`,
            or are the other types that it may have.
    """

    def changed(value: Any, type: Any) -> Any:
        members = alternatives(type)
        marks = [metadata for member, metadata in members if member is Path]
        if not isinstance(value, str) or not marks or later(value):
            return value
        word = any(get_origin(m) is Literal and value in get_args(m) for m, _ in members)
        if word or any(isinstance(m, re.Pattern) and m.fullmatch(value) for m in marks[0]):
            return value
        return change(value, (*marks[0], *(member for member, _ in members)))

    return _mapped(value, type, "", changed, lambda s: getattr(s.mark, "targets", ""))
