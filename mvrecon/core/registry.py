"""Registries of replaceable parts by name; a part is imported when first used.

A part comes from mvrecon's own tables (`parts.py`), the decorator `register` (notebooks, scripts),
or an installed plugin that declares an entry point in the group `mvrecon.plugins`, the kind leading
its name::

    [project.entry-points."mvrecon.plugins"]
    "projector.spect" = "mvrecon_spect.operators.projector:Spect"
"""

import difflib
import inspect
import re
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from functools import cache
from importlib import import_module
from importlib.machinery import ModuleSpec, PathFinder
from importlib.metadata import EntryPoint, entry_points
from importlib.util import find_spec
from pathlib import Path
from pkgutil import resolve_name
from typing import Any

from mvrecon.core.files.checks import shown
from mvrecon.core.signatures import options_of

GROUP = "mvrecon.plugins"
#: Registrations in order: the table, the name, and its previous value.
_REGISTERED: list[tuple[dict[str, str | Callable[..., Any]], str, Any]] = []
#: Top packages of the modules that `import_plugins` has imported.
_IMPORTED: set[str] = set()


@cache
def installed() -> tuple[EntryPoint, ...]:
    """All entry points that installed plugins declare for mvrecon."""
    return tuple(entry_points(group=GROUP))


def locate(module: str) -> ModuleSpec | None:
    """The spec of a module, as importlib's find_spec, but without importing its parent packages."""
    top, *rest = module.split(".")
    spec = find_spec(top)
    for depth in range(1, len(rest) + 1):
        if spec is None or spec.submodule_search_locations is None:
            return None
        spec = PathFinder.find_spec(".".join([top, *rest[:depth]]), spec.submodule_search_locations)
    return spec


def hint(name: str, known: Iterable[str]) -> str:
    """The end of an error message: the nearest known name, then all of them."""
    names = sorted(known)
    close = difflib.get_close_matches(name, names, n=1)
    nearest = f"; did you mean {close[0]!r}?" if close else "."
    return f"{nearest} Known: {', '.join(names)}"


@contextmanager
def importing(what: str) -> Iterator[None]:
    """Context for the import of a plugin: any error becomes an ImportError, and parts that it has
    registered are removed.

    Raises:
        ImportError: instead of whatever the import raised, including exits; the message begins with
            `what`.
    """
    mark = len(_REGISTERED)
    try:
        yield
    except (Exception, SystemExit) as error:
        for parts, name, before in reversed(_REGISTERED[mark:]):
            parts.pop(name) if before is None else parts.update({name: before})
        del _REGISTERED[mark:]
        raise ImportError(f"{what} does not import: {error}") from error


class Registry:
    """Parts of one kind by name.

    Args:
        kind: kind of the parts in the singular ("projector"), as in plugins' entry-point names.
        passed: number of leading arguments that mvrecon passes, which are no options.
        builtin: mvrecon's own parts, name -> "module:attribute".
    """

    def __init__(self, kind: str, passed: int = 0, /, **builtin: str):
        self.kind, self.passed = kind, passed
        self._parts: dict[str, str | Callable[..., Any]] = dict(builtin)

    def _plugins(self) -> list[tuple[str, str]]:
        prefix = f"{self.kind}."
        return [
            (p.name.removeprefix(prefix), p.value) for p in installed() if p.name.startswith(prefix)
        ]

    def names(self) -> list[str]:
        """All known names, without importing any part."""
        return sorted({*self._parts, *(name for name, _ in self._plugins())})

    def origin(self, name: str) -> str:
        """Location of a part, as "module:attribute", without importing it.

        Raises:
            LookupError: an unknown name, or one that two parts claim.
        """
        claims = {where for plugin, where in self._plugins() if plugin == name}
        if name in self._parts:
            claims.add(_where(self._parts[name]))
        if len(claims) > 1:
            raise LookupError(
                f"{len(claims)} parts of kind {self.kind!r} are named {name!r}: "
                f"{', '.join(sorted(claims))}"
            )
        if not claims:
            raise LookupError(f"No {self.kind} is named {name!r}{hint(name, self.names())}")
        return claims.pop()

    def register(self, name: str) -> Callable[[Any], Any]:
        """Decorator that registers a class or factory under a free name.

        A redefinition at the same place, as by rerunning a notebook's cell, replaces the former
        one.

        Raises:
            LookupError: another part has the name.
        """

        def add(part: Any) -> Any:
            if name in self.names() and self.origin(name) != _where(part):
                raise LookupError(f"The {self.kind} {name!r} exists already: {self.origin(name)}")
            _REGISTERED.append((self._parts, name, self._parts.get(name)))
            self._parts[name] = part
            return part

        return add

    def get(self, name: str) -> Callable[..., Any]:
        """Import and return one part.

        Raises:
            LookupError: an unknown name; the message gives the nearest name and all names.
            ImportError: the part's module does not import; the message names the part.
        """
        where = self.origin(name)
        part = self._parts.get(name)
        if callable(part):
            return part
        with importing(f"The {self.kind} {name!r} ({where})"):
            return resolve_name(where)

    def build(self, name: str, /, *args: Any, **options: Any) -> Any:
        """Construct one part.

        Raises:
            TypeError: an unknown option; the message names the nearest.
        """
        return self._accepting(name, options)(*args, **options)

    def _accepting(self, name: str, options: Iterable[str]) -> Callable[..., Any]:
        """Return a part, checking that it has these options."""
        part = self.get(name)
        known, others = options_of(part)
        if not others:
            check_options(f"The {self.kind} {name!r}", options, known)
        return part

    def takes(self, name: str, option: str) -> bool:
        """Whether an option is in a part's own signature.

        Raises:
            LookupError: the name is unknown.
        """
        return option in options_of(self.get(name))[0]

    def check(self, config: Mapping[str, Any]) -> None:
        """Check the mapping of `from_config` without building the part.

        Raises:
            LookupError: an unknown name.
            TypeError: no name, or an unknown option.
        """
        self._accepting(*self._split(config))

    def from_config(self, config: Mapping[str, Any], *args: Any, **keywords: Any) -> Any:
        """Construct a part from a mapping `{"name": ..., **options}`."""
        name, options = self._split(config)
        return self.build(name, *args, **keywords, **options)

    def _split(self, config: Mapping[str, Any]) -> tuple[str, dict[str, Any]]:
        """The name and the options of a part's mapping."""
        if not isinstance(config, Mapping):
            raise TypeError(
                f"A {self.kind} needs a mapping of its name and options, got {config!r}; the "
                f"command line chooses it by its group, {self.kind}@<place>={config}"
            )
        if not isinstance(config.get("name"), str):
            got = sorted(key for key in config if key != "name")
            raise TypeError(
                f"A {self.kind} needs a 'name' beside its options ({self.kind}.name=...), got only "
                f"{got}. Known: {', '.join(self.names())}"
            )
        return config["name"], {key: value for key, value in config.items() if key != "name"}


def check_options(owner: str, options: Iterable[Any], known: Iterable[str], path: str = "") -> None:
    """Check the names of options.

    Args:
        owner: what has the options, for the message.
        options: names.
        known: names of all options.
        path: place of the owner in settings, where an experiment may set an option of another part.

    Raises:
        TypeError: an unknown option; the message gives the nearest, and all.
    """
    names = list(known)
    for option in options:
        if option not in names:
            words = hint(str(option), names)
            if path and "did you mean" not in words:
                words += f"; ~{path}.{option} removes it"
            raise TypeError(f"{owner} has no option {option!r}{words}")


def from_options(kind: Callable[..., Any], owner: str, options: Any) -> Any:
    """Construct a dataclass of options from a mapping.

    Raises:
        TypeError: not a mapping, or an unknown option; the message gives the nearest, and all.
    """
    known = list(inspect.signature(kind).parameters)
    if not isinstance(options, Mapping):
        raise TypeError(f"{owner} is a mapping of {', '.join(known)}, got {options!r}")
    check_options(owner, options, known)
    return kind(**options)


def check_choice(name: str, value: Any, known: Iterable[str]) -> None:
    """Check the value of an option.

    Raises:
        ValueError: not one of the known values.
    """
    choices = list(known)
    if value not in choices:
        raise ValueError(f"{name} must be one of {', '.join(choices)}, got {value!r}")


def _where(part: Any) -> str:
    return part if isinstance(part, str) else f"{part.__module__}:{part.__qualname__}"


#: A line of Python that imports mvrecon.
IMPORT_LINE = re.compile(r"^\s*(from|import(.*,)?)\s+mvrecon\b", re.MULTILINE)
#: Placeholder spec of an invalid module name.
NOT_A_NAME = ModuleSpec("", None)


def import_plugins(modules: str | Iterable[str] | None) -> None:
    """Import the modules of the setting `plugins`, which add parts by `@REGISTRY.register`.

    Args:
        modules: their names; one string is one module.

    Raises:
        ModuleNotFoundError: a module is not on Python's path.
        ImportError: a module does not import; the message names it.
        PermissionError: a module that is not a plugin.
    """
    check_plugins(modules)
    for module in names(modules):
        _IMPORTED.add(module.partition(".")[0])
        with importing(f"The plugin module {module!r} (setting 'plugins')"):
            import_module(module)


def check_plugins(modules: str | Iterable[str] | None) -> None:
    """Check the modules of the setting `plugins`, without importing any.

    The setting may come from an untrusted file, so only modules written for mvrecon are allowed,
    with a line that imports mvrecon; the source is read before any of it runs.

    Raises:
        ModuleNotFoundError: a module is not on Python's path.
        PermissionError: a module that is not a plugin.
    """
    for module in names(modules):
        spec = locate(module) if all(map(str.isidentifier, module.split("."))) else NOT_A_NAME
        if spec is None:
            raise ModuleNotFoundError(
                f"The setting 'plugins' names {shown(module)}, and no such module is installed or "
                f"on Python's path; plugins=[{module}] on the command line also looks into the "
                f"current folder",
                name=module,
            )
        source = Path(spec.origin or "")
        if source.suffix != ".py" or not IMPORT_LINE.search(source.read_text(encoding="utf-8")):
            raise PermissionError(
                f"The setting 'plugins' names {shown(module)}; expected a module on Python's path "
                f"whose own source imports mvrecon"
            )


def in_plugin(module: str) -> bool:
    """Whether a module is of a plugin, installed or in the setting `plugins`, other than mvrecon's
    own plugins, `mvrecon_*`.
    """
    top = module.partition(".")[0]
    of_parts = {re.split("[.:]", point.value)[0] for point in installed()}
    return top in _IMPORTED | of_parts and top.partition("_")[0] != "mvrecon"


def names(modules: str | Iterable[str] | None) -> list[str]:
    """The module names in the setting `plugins`."""
    return [modules] if isinstance(modules, str) else [str(module) for module in modules or ()]
