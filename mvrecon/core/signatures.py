"""Options of functions and classes as signatures, type hints and docstrings describe them; types in
a YAML user's terms.
"""

import inspect
import re
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import MISSING, dataclass, fields, is_dataclass
from inspect import Parameter
from pathlib import Path
from pkgutil import resolve_name
from types import NoneType, SimpleNamespace, UnionType
from typing import (
    Annotated,
    Any,
    Literal,
    Union,
    Unpack,
    get_args,
    get_origin,
    get_type_hints,
    is_typeddict,
)

from annotated_types import Ge, Gt, Len

#: Types of plain data.
PLAIN_TYPES = (int, float, str, bool, Path, dict, list, tuple, Any)
CONTAINER_TYPES = (Literal, Sequence, Mapping, list, tuple, dict)
#: An option without a default.
REQUIRED = Parameter.empty


#: Names a class of Lightning's or mvrecon's in the place of a part's name.
TARGET_KEY = "_target_"


@dataclass(frozen=True)
class PartOf:
    """Marks the type of a mapping of a part's name and options.

    Args:
        kind: kind of the part.
        also: "module:name" of further options, which are not the part's own.
        classical: whether only classical methods are allowed: functions, without weights.
        partial: options without a name change those of a part that the app knows.
        targets: "module:name" of f(target) -> the class of a `_target_`, which may take the place
            of a name.
        supplied: keywords that mvrecon gives itself.
    """

    kind: str
    also: str = ""
    classical: bool = False
    partial: bool = False
    targets: str = ""
    supplied: tuple[str, ...] = ()

    def key_in(self, node: Mapping[str, object]) -> str:
        """The key of a mapping that says which part it is."""
        return TARGET_KEY if self.targets and TARGET_KEY in node else "name"


@dataclass(frozen=True)
class NamesOf:
    """Marks the type of a mapping whose keys are names of parts, and whose values are numbers.

    Args:
        kind: kind of the parts.
    """

    kind: str


class OptionsOf:
    """Marks the type of a mapping of the keywords of functions, classes or TypedDicts.

    Args:
        owners: "module:name" of each; of an option of two the first one's type counts.
        passed: number of their leading arguments that are no options.
    """

    def __init__(self, *owners: str, passed: int = 0):
        self.owners, self.passed = owners, passed


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
    call: Any = owner
    if inspect.isclass(owner):  # named tuples, for example, have no constructor but __new__
        call = owner.__new__ if owner.__init__ is object.__init__ else owner.__init__
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


def options_of_section(section: OptionsOf) -> tuple[dict[str, Option], bool]:
    """The options of all owners of a section, where the first one's stand."""
    found = [options_of(resolve_name(owner), section.passed) for owner in section.owners]
    options = {k: option for each, _ in reversed(found) for k, option in each.items()}
    return options, any(others for _, others in found)


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
        member in PLAIN_TYPES or get_origin(member) in CONTAINER_TYPES or is_record(member)
        for member in members
    )


def is_record(type: Any) -> bool:
    """Whether a type is a TypedDict, or a dataclass of plain values."""
    if is_typeddict(type):
        return True
    return (
        inspect.isclass(type)
        and is_dataclass(type)
        and all(settable(option.type) for option in options_of(type)[0].values())
    )


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
        types = items(member, lengths[0] if lengths else 1)
        dots = ", ..." if not lengths and (origin is not tuple or inner[1:] == (...,)) else ""
        return f"[{', '.join(map(in_words, types))}{dots}]"
    if origin in (Mapping, dict) or is_record(member):
        marks = [m for m in metadata if isinstance(m, PartOf)]
        return f"name and options of a {marks[0].kind}" if marks else "a mapping"
    if member is Path:
        return "path"
    name = member.__name__ if inspect.isclass(member) else str(member)
    return name + "".join(bounds)


def items(type: Any, count: int) -> list[Any]:
    """The types of a list's entries."""
    types = get_args(type)
    one = get_origin(type) is not tuple or types[1:] == (...,)
    return [types[0]] * count if one else list(types)


def default_in_words(value: Any) -> str:
    """A default as in Python, of a function or an object by its name."""
    if value is ...:
        return "..."
    if isinstance(value, str | int | float | tuple | list | dict | None):
        return repr(value)
    return getattr(value, "__name__", None) or type(value).__name__
