"""Descriptions of parts (docstring, options, defaults) from their source without importing it, and
checks of plain settings against them before any heavy import.
"""

import ast
import re
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from copy import deepcopy
from dataclasses import dataclass, field, replace
from functools import cache
from importlib.util import resolve_name
from pathlib import Path
from typing import Any

from mvrecon.core.files.checks import shown
from mvrecon.core.parts import LISTED, LOSSES, REGISTRIES
from mvrecon.core.quantities import (
    LENGTHS,
    PLAIN,
    RANGES,
    fits,
    in_words,
    settable,
    with_paths,
)
from mvrecon.core.registry import check_options, hint, installed, locate

#: Number of leading arguments of a part of each kind that mvrecon passes, which are no options; of
#: methods, those of functions.
PASSED = {
    **{"method": 2, "correct": 2, "streamed": 3, "scatter": 3, "network": 2, "optimizer": 1},
    **{"views": 1, "volume": 3, "loss": 3, "metric": 4},
}
#: Arguments that mvrecon passes by name.
PASSED_BY_NAME = {"projector": ("grid", "cameras")}
#: Kinds of settings with other names.
KINDS = {"test_scene": "scene", "scenes": "scene", "start": "method"}
#: Settings that are not parts, and their consumers.
SECTIONS = {
    "grid": "mvrecon.geometry.grid:Grid.centred",
    "views": "mvrecon.data.projections.views:Measured",
    "data": "mvrecon.data.module:Loading",
    "acquisition": "mvrecon.data.acquisition.detector:Acquisition",
    "acquisition.disturbed": "mvrecon.data.acquisition.disturbances:Disturbance",
    "loss": "mvrecon.training.losses:Weights",
}

Definition = ast.ClassDef | ast.FunctionDef
#: Names of types that `quantities` knows, and of those that it takes for any value.
OWN_TYPES = {*PLAIN, *RANGES, *LENGTHS, "Literal", "Sequence", "Mapping", "Any", "list", "tuple"}


@dataclass(frozen=True)
class Option:
    """One option of a part: its default and type as written ("" for none), and its docstring text,
    with the unit.
    """

    default: str = ""
    type: str = ""
    text: str = ""

    def line(self, name: str) -> str:
        """The option with its default, its type where it has none, and its text."""
        value = f"={self.default}" if self.default else f" ({in_words(self.type) or 'needed'})"
        return f"{name}{value}  {self.text}".rstrip()


@dataclass(frozen=True)
class Part:
    """Description of one part: `catch_all` allows further options, `is_class` distinguishes classes
    from functions; `error` is the reason why it cannot be used or described.
    """

    kind: str
    name: str
    origin: str
    summary: str = ""
    options: Mapping[str, Option] = field(default_factory=dict)
    catch_all: bool = False
    is_class: bool = False
    error: str = ""


def describe(kind: str, name: str, check: bool = False) -> Part:
    """Describe one part from its source; with `check` it is also imported, with any exception as
    `error`.
    """
    origin = ""
    try:
        origin = LISTED[kind].origin(name)
        if check:
            LISTED[kind].get(name)
        module, _, attribute = origin.partition(":")
        module, node = definition(module, attribute)
    except (LookupError, ImportError, SyntaxError, ValueError) as error:  # __main__ has no spec
        return Part(kind, name, origin, error=str(error))
    summary = (ast.get_docstring(node) or "").partition("\n\n")[0].replace("\n", " ")
    is_class = isinstance(node, ast.ClassDef)
    passed = 0 if kind == "method" and is_class else PASSED.get(kind, 0)
    options, catch_all = _options(module, node, passed)
    for given in PASSED_BY_NAME.get(kind, ()):
        options.pop(given, None)
    origin += _release(kind, name)
    return Part(kind, name, origin, summary, options, catch_all, is_class)


def required(kind: str, name: str) -> list[str]:
    """The options of a part that have no default, such as the path of a file."""
    return [option for option, given in describe(kind, name).options.items() if not given.default]


def definition(module: str, name: str) -> tuple[str, Definition]:
    """Find the definition of a class or function, through `from ... import`, and its syntax tree.

    Raises:
        ImportError: no such module, or no such name in it.
    """
    for node in _tree(module).body:
        if isinstance(node, Definition) and node.name == name:
            return module, node
        if isinstance(node, ast.ImportFrom) and node.module:
            for alias in node.names:
                if (alias.asname or alias.name) == name:
                    return definition(_absolute(module, node), alias.name)
    raise ImportError(f"{module} defines no class or function {name!r}")


def _absolute(module: str, node: ast.ImportFrom) -> str:
    """The absolute module name of a `from ... import` in another module."""
    spec = locate(module)
    is_package = spec is not None and spec.submodule_search_locations is not None
    package = module if is_package else module.rpartition(".")[0]
    return resolve_name("." * node.level + (node.module or ""), package)


def describe_section(section: str) -> Part:
    """Describe a setting that is not a part, one of `SECTIONS`, as a part of the kind "setting"."""
    summary = f"The options of `{section}.` in a configuration."
    return Part("setting", section, SECTIONS[section], summary, options_of(section))


def options_of(section: str) -> Mapping[str, Option]:
    """The options of a setting that is not a part, one of `SECTIONS`."""
    module, _, name = SECTIONS[section].partition(":")
    owner, _, method = name.partition(".")
    module, node = definition(module, owner)
    if not method:
        return _options(module, node)[0]
    made = next(m for m in node.body if isinstance(m, ast.FunctionDef) and m.name == method)
    return _arguments(module, made, _texts(ast.get_docstring(made) or ""), 1)[0]


def parts_in(
    settings: Mapping[str, Any], path: str = ""
) -> Iterator[tuple[str, str, Mapping[str, Any]]]:
    """Iterate over all parts in plain settings, at any depth: path, kind and node."""
    for where, kind, node in _nodes(settings, path):
        if kind in REGISTRIES and isinstance(node.get("name"), str):
            yield where, kind, node


def _nodes(
    settings: Mapping[str, Any], path: str = ""
) -> Iterator[tuple[str, str, Mapping[str, Any]]]:
    """Iterate over all mappings in plain settings: path, the kind of a part with this key, node."""
    for key, node in settings.items():
        if isinstance(node, Mapping):
            kind = "method" if path == "compare." else KINDS.get(str(key), str(key))
            yield f"{path}{key}", kind, node
            yield from _nodes(node, f"{path}{key}.")


@cache
def _tree(module: str) -> ast.Module:
    spec = locate(module)
    if spec is None or not spec.origin or not spec.origin.endswith(".py"):
        raise ImportError(f"No source found for module {module!r}")
    return ast.parse(Path(spec.origin).read_text(encoding="utf-8"))


def _options(module: str, node: Definition, passed: int = 0) -> tuple[dict[str, Option], bool]:
    """The options of a function, of a class's `__init__`, or of a dataclass and its bases, without
    the leading arguments that mvrecon passes; and whether it allows others.
    """
    texts = _texts(ast.get_docstring(node) or "")
    if isinstance(node, ast.FunctionDef):
        return _arguments(module, node, texts, passed)
    for member in node.body:
        if isinstance(member, ast.FunctionDef) and member.name == "__init__":
            texts |= _texts(ast.get_docstring(member) or "")
            return _arguments(module, member, texts, passed + 1)  # after self
    options, catch_all = {}, False
    for base in node.bases:
        with suppress(ImportError):  # bases from other libraries have no options
            if isinstance(base, ast.Name):
                inherited, others = _options(*definition(module, base.id))
                options, catch_all = options | inherited, catch_all or others
    if any("dataclass" in ast.unparse(decorator) for decorator in node.decorator_list):
        for name, option in _fields(module, node, texts).items():
            inherited_text = options.get(name, option).text
            options[name] = replace(option, text=option.text or inherited_text)
    return {
        name: replace(option, text=option.text or texts.get(name, ""))
        for name, option in options.items()
    }, catch_all


def _texts(docstring: str) -> dict[str, str]:
    """The text of each argument in a docstring's section `Args`."""
    section = re.search(r"^Args:\n(.*?)(?=^\S|\Z)", docstring, re.M | re.S)
    entries = re.findall(
        r"^    (\w[\w, ]*): (.*?)(?=^    \w|\Z)", section[1] if section else "", re.M | re.S
    )
    return {
        name: " ".join(text.split())
        for names, text in entries
        for name in re.findall(r"\w+", names)
    }


def _arguments(
    module: str, function: ast.FunctionDef, texts: Mapping[str, str], passed: int
) -> tuple[dict[str, Option], bool]:
    """The options of a function after so many arguments that are passed by position, those of
    `**name: Unpack[T]` included, and whether it allows others.
    """
    a = function.args
    positional = [*a.posonlyargs, *a.args]
    defaults = [None] * (len(positional) - len(a.defaults)) + a.defaults
    pairs = [
        *[*zip(positional, defaults, strict=True)][passed:],
        *zip(a.kwonlyargs, a.kw_defaults, strict=True),
    ]
    options = {
        argument.arg: Option(
            _written(default), _type(module, argument.annotation), texts.get(argument.arg, "")
        )
        for argument, default in pairs
    }
    if a.kwarg is None:
        return options, False
    match a.kwarg.annotation:
        case ast.Subscript(ast.Name("Unpack"), ast.Name(name)):
            with suppress(ImportError):  # not found: any option
                module, found = definition(module, name)
                shared = _fields(module, found, _texts(ast.get_docstring(found) or ""))
                return options | {k: replace(o, default="...") for k, o in shared.items()}, False
    return options, True


def _fields(module: str, node: Definition, texts: Mapping[str, str]) -> dict[str, Option]:
    return {
        member.target.id: Option(
            _written(member.value),
            _type(module, member.annotation),
            texts.get(member.target.id, ""),
        )
        for member in node.body
        if isinstance(member, ast.AnnAssign)
        and isinstance(member.target, ast.Name)
        and "ClassVar" not in ast.unparse(member.annotation)
        and "init=False" not in _written(member.value)
    }


def _type(module: str, annotation: ast.expr | None) -> str:
    """A type as written, with the names that its module gives to others replaced by these."""
    if annotation is None:
        return ""
    for name in {n.id for n in ast.walk(annotation) if isinstance(n, ast.Name)} - OWN_TYPES:
        if meant := _alias(module, name):
            annotation = _Replaced(name, meant).visit(deepcopy(annotation))
    return ast.unparse(annotation)


class _Replaced(ast.NodeTransformer):
    """Replaces a name by an expression."""

    def __init__(self, name: str, meant: ast.expr):
        self.name, self.meant = name, meant

    def visit_Name(self, node: ast.Name) -> ast.expr:
        """The expression, or another name."""
        return self.meant if node.id == self.name else node


def _alias(module: str, name: str) -> ast.expr | None:
    """The union or choice of literals that a module means by a name; None for other names."""
    try:
        body = _tree(module).body
    except (ImportError, SyntaxError):
        return None
    for node in body:
        match node:
            case ast.Assign([ast.Name(id)], ast.BinOp() | ast.Subscript(ast.Name("Literal")) as of):
                if id == name:
                    return of
            case ast.ImportFrom(module=str(), names=names):
                for alias in names:
                    if (alias.asname or alias.name) == name:
                        return _alias(_absolute(module, node), alias.name)
    return None


def _written(expression: ast.expr | None) -> str:
    return "" if expression is None else ast.unparse(expression)


def _release(kind: str, name: str) -> str:
    """The plugin and release of a part; empty for mvrecon's own."""
    for point in installed():
        if point.name == f"{kind}.{name}" and point.dist is not None:
            return f" ({point.dist.name} {point.dist.version})"
    return ""


LENGTH = "PositiveInt | Literal[-1]"
#: Types of settings that are in no signature.
WRITTEN = {
    "camera.detector": {
        "pixels": "PositiveInt | Pair[PositiveInt] | Literal['fit'] | None",
        "pixel_mm": "PositiveFloat | Pair[PositiveFloat] | Literal['fit'] | None",
        "offset_mm": "float | Pair[float] | None",
    },
    "grid": {"like": "str | Path", "seen_by": "PositiveFloat"},
    "data": {"overlap": "bool", "sizes": "Mapping[str, int]"},
    "data.sizes": dict.fromkeys(("train", "val", "test"), "NonNegativeInt"),
    "optimizer": {
        "name": "str",
        "lr": "PositiveFloat",
        "weight_decay": "NonNegativeFloat",
        "momentum": "NonNegativeFloat",
        "schedule": "Literal['cosine', 'one_cycle', 'constant']",
        "betas": "Pair[NonNegativeFloat]",
        "warmup": "NonNegativeFloat",
    },
    "trainer": {
        "max_steps": LENGTH,
        "max_epochs": LENGTH,
        "num_nodes": "PositiveInt",
        "devices": "PositiveInt | Literal[-1] | str | Sequence[NonNegativeInt]",
        "accumulate_grad_batches": "PositiveInt",
        "gradient_clip_val": "NonNegativeFloat | None",
        "val_check_interval": "PositiveInt | PositiveFloat | None",
        "log_every_n_steps": "NonNegativeInt",
        "accelerator": "str",
        "strategy": "str",
        "precision": "str | Literal[16, 32, 64] | None",
        "check_val_every_n_epoch": "PositiveInt | None",
        "num_sanity_val_steps": "NonNegativeInt | Literal[-1] | None",
        "deterministic": "bool | Literal['warn'] | None",
        "enable_model_summary": "bool | None",
    },
    "stop": {"sigma": "NonNegativeFloat | None"},
}
#: Types of settings of parts for which the apps allow more than the parts do.
INNER = {"camera.detector": "Mapping[str, Any] | Literal['fit']"}
#: Types of paths among an app's own settings.
PLACES = {"out": "Path", "checkpoint": "WeightsFile", "init_from": "WeightsFile"}
#: Settings with entries of any name, each a mapping or null.
TABLES = ("compare", "callbacks", "logger")
#: Sections with further options of torch's and Lightning's.
OPEN_ENDED = ("optimizer", "trainer")


def change_paths(settings: Mapping[str, Any], change: Callable[[str, str], str]) -> dict[str, Any]:
    """Change every path in plain settings: of apps, of `SECTIONS`, and of parts at any depth, by
    the types of their options. Those of modules of `plugins` are known after their import.

    Args:
        settings: to copy.
        change: f(path, its type), see `with_paths`.
    """
    placed = {key: with_paths(v, PLACES.get(key, ""), change) for key, v in settings.items()}
    return {key: _change_paths(key, value, change, key) for key, value in placed.items()}


def _change_paths(key: str, node: Any, change: Callable[[str, str], str], path: str) -> Any:
    if isinstance(node, list):
        return [_change_paths(key, item, change, path) for item in node]
    if not isinstance(node, Mapping):
        return node
    kind = "method" if path.startswith("compare.") and path.count(".") == 1 else key
    kind, name = KINDS.get(kind, kind), node.get("name")
    options: dict[str, Option] = {k: Option(type=t) for k, t in WRITTEN.get(path, {}).items()}
    if kind in LISTED and isinstance(name, str):
        options |= describe(kind, name).options
    elif path in SECTIONS:
        options |= options_of(path)
    placed = {k: with_paths(v, options.get(k, Option()).type, change) for k, v in node.items()}
    return {k: _change_paths(k, v, change, f"{path}.{k}") for k, v in placed.items()}


def check_parts(settings: Mapping[str, Any]) -> None:
    """Check all parts in settings against their source: name, options, and values of known type,
    range and length; likewise grid, data, acquisition, loss, optimiser and trainer.

    Names and options that modules of `plugins` may provide are not checked.

    Raises:
        LookupError: an unknown name.
        TypeError: an unknown option, or a value of another type.
    """
    _check_sections(settings)
    for path, kind, node in _nodes(settings):
        name = node.get("name", "")
        nameless = path.endswith(".start") and not name
        if kind in REGISTRIES and (nameless or not isinstance(name, str)):
            known = ", ".join(REGISTRIES[kind].names())
            raise TypeError(f"{path}.name: expected one of {known}, got {shown(name)}")
    for path, kind, node in parts_in(settings):
        registry, name = REGISTRIES[kind], node["name"]
        if _later(name):
            continue
        if name not in registry.names():
            if settings.get("plugins"):
                continue
            raise LookupError(f"{path}.name: no {kind} is {name!r}{hint(name, registry.names())}")
        options = {key: value for key, value in node.items() if key != "name"}
        if path == "method" or path.rpartition(".")[0] == "compare":
            _check_assumed(path, options.pop("assume", None), settings.get("projector"))
        _check_options(path, kind, name, options)


def _check_sections(settings: Mapping[str, Any]) -> None:
    """Check the settings that are not parts, such as the grid."""
    for table in TABLES:
        entries = settings.get(table)
        for name, node in entries.items() if isinstance(entries, Mapping) else ():
            if not (node is None or isinstance(node, Mapping) or _later(node)):
                raise TypeError(
                    f"{table}.{name}: expected a mapping of settings, got {shown(node)}"
                )
    known = {section: dict(options_of(section)) for section in SECTIONS}
    for section, types in WRITTEN.items():
        known.setdefault(section, {}).update({key: Option(type=t) for key, t in types.items()})
    known["loss"] |= dict.fromkeys(LOSSES.names(), Option(type="float"))
    open_ended = (*OPEN_ENDED, "loss") if settings.get("plugins") else OPEN_ENDED
    for section, options in known.items():
        node: Any = settings
        for key in section.split("."):
            node = node.get(key) if isinstance(node, Mapping) else None
        if not isinstance(node, Mapping):
            if node is not None and "." in section:
                _check_type(section, node, Option(type=INNER.get(section, "Mapping[str, Any]")))
            continue
        if section not in open_ended:
            check_options(section, node, options)
        given = [key for key in ("size", "shape") if section == "grid" and key in node]
        if given and "views" not in settings and not any(node[key] for key in given):
            _check_type(f"grid.{given[0]}", node[given[0]], Option(type="Triple[PositiveInt]"))
        for key, value in node.items():
            if value is not None or section != "grid" or "views" not in settings:
                # null: chosen by mvrecon-reconstruct
                _check_type(f"{section}.{key}", value, options.get(key, Option()))


def _check_options(path: str, kind: str, name: str, options: Mapping[str, Any]) -> None:
    part = describe(kind, name)
    if part.error:
        return  # building the part raises
    if path.endswith(".start") and part.is_class:
        raise TypeError(f"{path}.name: expected a classical method, got the learned one {name!r}")
    if not part.catch_all:
        known = [key for key, o in part.options.items() if key in options or settable(o.type)]
        check_options(f"{path} (the {kind} {name!r})", options, known, path)
    for key, value in options.items():
        where, option = f"{path}.{key}", part.options.get(key, Option())
        _check_type(where, value, replace(option, type=INNER.get(where, option.type)))


def check_arguments(path: str, where: str, settings: Mapping[str, Any]) -> None:
    """Check settings against the signature of a class that is no part of a registry.

    Args:
        path: of the settings, for messages; "" for an app's own.
        where: the class, as "module:name".
        settings: by name, those of other names included.

    Raises:
        TypeError: a value of another type.
    """
    module, _, name = where.partition(":")
    options, _ = _options(*definition(module, name))
    for key in options.keys() & settings.keys():
        _check_type(f"{path}{key}", settings[key], options[key])


def _check_assumed(path: str, assumed: Any, projector: Mapping[str, Any] | None) -> None:
    """Check a method's assumptions: a subset of the projector's options."""
    if assumed is None or not projector or "name" not in projector:
        return
    if not isinstance(assumed, Mapping):
        raise TypeError(f"{path}.assume: expected options of the projector, got {shown(assumed)}")
    part = describe("projector", projector["name"])
    if not part.error and not part.catch_all:
        where = f"{path}.assume (the projector {projector['name']!r})"
        check_options(where, assumed, part.options)


def _check_type(path: str, value: Any, option: Option) -> None:
    if _later(value):
        return
    if not fits(value, option.type):
        text = f" ({option.text})" if option.text else ""
        raise TypeError(f"{path}: expected {in_words(option.type)}, got {shown(value)}{text}")


def _later(value: Any) -> bool:
    """Whether a setting is interpolated, or still missing."""
    return isinstance(value, str) and (value == "???" or "${" in value)
