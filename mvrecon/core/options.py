"""Options of parts and of sections of settings: described by signatures, type hints and docstrings,
and checked as the plain data that they are in YAML.

A mapping of options is recognised by its type: `PartOf` for a part's name and options, `OptionsOf`
for the keywords of a function or class, a `TypedDict`, or a dataclass of plain values.
"""

import inspect
import json
import math
import re
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import MISSING, dataclass, field, fields, is_dataclass
from inspect import Parameter
from pathlib import Path
from pkgutil import resolve_name
from types import NoneType, SimpleNamespace, UnionType
from typing import (
    Annotated,
    Any,
    Literal,
    NamedTuple,
    Union,
    Unpack,
    get_args,
    get_origin,
    get_type_hints,
    is_typeddict,
)

from annotated_types import Ge, Gt, Len
from pydantic import ConfigDict, TypeAdapter, ValidationError

from mvrecon.core.files.checks import shown
from mvrecon.core.parts import LISTED, REGISTRIES, TARGET_KEY, NamesOf, Options, OptionsOf, PartOf
from mvrecon.core.quantities import WEIGHTS_MARK, NonNegativeFloat
from mvrecon.core.registry import check_options, hint, installed

#: Types of plain data.
PLAIN_TYPES = (int, float, str, bool, Path, dict, list, tuple, Any)
CONTAINER_TYPES = (Literal, Sequence, Mapping, list, tuple, dict)
#: An option without a default.
REQUIRED = Parameter.empty
ANY_CLASS = ConfigDict(arbitrary_types_allowed=True)


@dataclass(frozen=True)
class Option:
    """One option: its type, its default (... if it may be left out), and its text in the docstring,
    with the unit.
    """

    type: Any = Any
    default: Any = REQUIRED
    text: str = ""

    def line(self, name: str) -> str:
        """The option with its default, or its type where it has none, and its text."""
        given = f"={default_in_words(self.default)}"
        value = f" ({in_words(self.type) or 'needed'})" if self.default is REQUIRED else given
        return f"{name}{value}  {self.text}".rstrip()


@dataclass(frozen=True)
class Part:
    """Description of one part: `catch_all` allows further options, `is_class` distinguishes classes
    from functions; `error` is the reason why it cannot be imported.
    """

    kind: str
    name: str
    origin: str
    summary: str = ""
    options: Mapping[str, Option] = field(default_factory=dict)
    catch_all: bool = False
    is_class: bool = False
    error: str = ""


class Section(NamedTuple):
    """A mapping of options within plain settings: where it is, the mark of its type or the record
    that is its type, the options that it may have, and whether it may have others.
    """

    path: str
    node: Options
    mark: Any
    options: Mapping[str, Option]
    catch_all: bool


def describe(kind: str, name: str) -> Part:
    """Import one part and describe it; `error` if it has no such name or does not import."""
    registry, origin = LISTED[kind], ""
    try:
        origin = registry.origin(name)
        owner = registry.get(name)
    except (LookupError, ImportError) as error:
        return Part(kind, name, origin, error=str(error))
    is_class = inspect.isclass(owner)
    # a method's class is built from its options, and called with what a function is passed
    passed = 0 if kind == "method" and is_class else registry.passed
    options, catch_all = options_of(owner, passed)
    for point in installed():
        if point.name == f"{kind}.{name}" and point.dist is not None:
            origin += f" ({point.dist.name} {point.dist.version})"
    return Part(kind, name, origin, _summary(owner), options, catch_all, is_class)


def required(kind: str, name: str) -> list[str]:
    """The options of a part that have no default, such as the path of a file."""
    return [key for key, o in describe(kind, name).options.items() if o.default is REQUIRED]


def describe_section(name: str, type: Any) -> Part:
    """Describe a section of settings by its type, as a part of the kind "setting"."""
    ((member, metadata),) = alternatives(type)
    section = _section(member, metadata)
    options, _ = _options_of_section(section)
    summary = f"The options of `{name}.` in a configuration."
    return Part("setting", name, section.owners[0], summary, options)


def options_of(owner: Callable[..., Any], passed: int = 0) -> tuple[dict[str, Option], bool]:
    """The options of a function, class or TypedDict without its first `passed` arguments, and
    whether it takes others.
    """
    texts: dict[str, str] = {}
    for cls in reversed(owner.__mro__) if inspect.isclass(owner) else (owner,):
        if getattr(cls, "__module__", "") != "builtins":
            texts |= _texts(cls.__doc__)
    if is_typeddict(owner):
        types = get_type_hints(owner, include_extras=True)
        return {k: Option(t, ..., texts.get(k, "")) for k, t in types.items()}, False
    call: Any = owner.__init__ if inspect.isclass(owner) else owner
    texts |= _texts(call.__doc__)
    types = _hints(call)
    own = fields(owner) if is_dataclass(owner) else ()
    made = {f.name: f.default_factory for f in own if f.default_factory is not MISSING}
    parameters = [*inspect.signature(call).parameters.values()]
    by_place = sum(p.kind in (p.POSITIONAL_ONLY, p.POSITIONAL_OR_KEYWORD) for p in parameters)
    parameters = parameters[min(by_place, passed + inspect.isclass(owner)) :]
    kinds = {p.kind for p in parameters}
    if inspect.isclass(owner) and kinds == {Parameter.VAR_POSITIONAL, Parameter.VAR_KEYWORD}:
        return {}, False  # the constructor of a library's base class
    options, catch_all = {}, False
    for parameter in parameters:
        name, kind = parameter.name, parameter.kind
        type_ = types.get(name, Any)
        if kind in (Parameter.POSITIONAL_OR_KEYWORD, Parameter.KEYWORD_ONLY):
            default = made[name]() if name in made else parameter.default
            options[name] = Option(type_, default, texts.get(name, ""))
        elif kind is Parameter.VAR_KEYWORD and get_origin(type_) is Unpack:
            options |= options_of(get_args(type_)[0])[0]
        elif kind is Parameter.VAR_KEYWORD:
            catch_all = True
    return options, catch_all


def _hints(call: Callable[..., Any]) -> dict[str, object]:
    """The type hints of a function's parameters, without those that name what only type checkers
    import.
    """
    call, found = inspect.unwrap(call), {}
    for name, annotation in getattr(call, "__annotations__", {}).items():
        one = SimpleNamespace(__annotations__={name: annotation})
        with suppress(NameError, TypeError):
            found |= get_type_hints(one, getattr(call, "__globals__", {}), include_extras=True)
    return found


def _options_of_section(section: OptionsOf) -> tuple[dict[str, Option], bool]:
    """The options of all owners of a section, where the first one's stand."""
    found = [options_of(resolve_name(owner), section.passed) for owner in section.owners]
    options = {k: option for each, _ in reversed(found) for k, option in each.items()}
    return options, any(others for _, others in found)


def _summary(owner: Any) -> str:
    return " ".join((inspect.cleandoc(owner.__doc__ or "")).partition("\n\n")[0].split())


def _texts(docstring: str | None) -> dict[str, str]:
    """The text of each argument in a docstring's section `Args`."""
    section = re.search(r"^Args:\n(.*?)(?=^\S|\Z)", inspect.cleandoc(docstring or ""), re.M | re.S)
    entries = re.findall(
        r"^    (\w[\w, ]*): (.*?)(?=^    \w|\Z)", section[1] if section else "", re.M | re.S
    )
    return {
        name: " ".join(text.split())
        for names, text in entries
        for name in re.findall(r"\w+", names)
    }


def alternatives(type: Any) -> list[tuple[Any, tuple[Any, ...]]]:
    """The members of a union, each with the metadata of its annotations."""
    if get_origin(type) is Annotated:
        base, *metadata = get_args(type)
        return [(member, (*own, *metadata)) for member, own in alternatives(base)]
    if get_origin(type) in (Union, UnionType):
        return [pair for member in get_args(type) for pair in alternatives(member)]
    return [(type, ())]


def settable(type: Any) -> bool:
    """Whether plain data other than null may have a type; objects such as tensors are given in
    Python alone.
    """
    members = [member for member, _ in alternatives(type)]
    return members == [NoneType] or any(
        member in PLAIN_TYPES or get_origin(member) in CONTAINER_TYPES or _record(member)
        for member in members
    )


def _record(type: Any) -> bool:
    """Whether a type is a TypedDict, or a dataclass of plain values."""
    if is_typeddict(type):
        return True
    return (
        inspect.isclass(type)
        and is_dataclass(type)
        and all(settable(option.type) for option in options_of(type)[0].values())
    )


def fits(value: Any, type: Any) -> bool:
    """Whether plain data have a type, as pydantic's strict mode decides for JSON: an int is a
    float, but neither a bool nor a text is a number. The entries of a mapping of options are not
    looked at.
    """
    members = alternatives(type)
    if isinstance(value, Mapping):
        return any(
            get_origin(member) in (Mapping, dict) or member in (Any, dict) or _record(member)
            for member, _ in members
        )
    if value == "" and any(member is Path for member, _ in members):
        return False  # the current folder, as where a variable of the shell is not set
    return any(
        _is_plain(value, Annotated[member, *metadata] if metadata else member)
        for member, metadata in members
        if settable(member) and not _record(member)
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
        value: to copy.
        type: its type.
        path: where it is.
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
            pairs = enumerate(zip(value, _items(member, len(value)), strict=False))
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
    return member if _record(member) else None


def _options(node: Options, section: Any) -> tuple[Mapping[str, Option], bool]:
    if isinstance(section, OptionsOf):
        return _options_of_section(section)
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
    kind = kind_of(option.type)
    if isinstance(value, Mapping) and fits(value, option.type):
        if kind in REGISTRIES and "." in path and not value.get("name"):
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


def kind_of(type: Any) -> str:
    """The kind of the parts that a type names; "" for none."""
    marks = (mark for _, metadata in alternatives(type) for mark in metadata)
    return next((mark.kind for mark in marks if isinstance(mark, PartOf)), "")


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


def with_paths(value: Any, type: Any, change: Callable[[str, bool], str | Path]) -> Any:
    """Change every path within plain data of a type, but not those of callbacks and loggers, which
    are relative to the run's folder.

    A text is a path if the type has `Path`, unless it is one of the type's literals.

    Args:
        value: to copy.
        type: its type.
        change: f(path, whether it may be a name of weights).
    """

    def changed(value: Any, type: Any) -> Any:
        members = alternatives(type)
        marks = [metadata for member, metadata in members if member is Path]
        word = any(get_origin(m) is Literal and value in get_args(m) for m, _ in members)
        if not isinstance(value, str) or not marks or word or later(value):
            return value
        return change(value, WEIGHTS_MARK in marks[0])

    return _mapped(value, type, "", changed, lambda s: getattr(s.mark, "targets", ""))


def _items(type: Any, count: int) -> list[Any]:
    """The types of a list's entries."""
    types = get_args(type)
    one = get_origin(type) is not tuple or types[1:] == (...,)
    return [types[0]] * count if one else list(types)


def in_words(type: Any) -> str:
    """Describe a type in a YAML user's terms; "" for any."""
    members = dict(alternatives(type))
    shown = {m: metadata for m, metadata in members.items() if m is not str or Path not in members}
    return " or ".join(dict.fromkeys(_spoken(*pair) for pair in shown.items()))


def _spoken(member: Any, metadata: tuple[Any, ...]) -> str:
    bounds = [f" > {m.gt}" for m in metadata if isinstance(m, Gt)]
    bounds += [f" >= {m.ge}" for m in metadata if isinstance(m, Ge)]
    origin, inner = get_origin(member), get_args(member)
    if member is NoneType:
        return "null"
    if member is Any:
        return ""
    if origin is Literal:
        return " or ".join(map(str, inner))
    if origin in (Sequence, list, tuple):
        lengths = [m.min_length for m in metadata if isinstance(m, Len)]
        types = _items(member, lengths[0] if lengths else 1)
        dots = ", ..." if not lengths and (origin is not tuple or inner[1:] == (...,)) else ""
        return f"[{', '.join(map(in_words, types))}{dots}]"
    if origin in (Mapping, dict) or _record(member):
        marks = [m for m in metadata if isinstance(m, PartOf)]
        return f"name and options of a {marks[0].kind}" if marks else "a mapping"
    if member is Path:
        return "path"
    name = member.__name__ if inspect.isclass(member) else str(member)
    return name + "".join(bounds)


def default_in_words(value: Any) -> str:
    """A default as in Python, of a function or an object by its name."""
    if value is ...:
        return "..."
    if isinstance(value, str | int | float | tuple | list | dict | None):
        return repr(value)
    return getattr(value, "__name__", None) or type(value).__name__
