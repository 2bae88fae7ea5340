"""Import the user's own modules that the setting `plugins` names."""

import re
from collections.abc import Iterable
from importlib import import_module
from importlib.machinery import ModuleSpec
from pathlib import Path

from mvrecon.core.files.checks import shown
from mvrecon.core.registry import importing, locate

#: A line of Python that imports mvrecon.
IMPORT = re.compile(r"^\s*(from|import(.*,)?)\s+mvrecon\b", re.MULTILINE)
#: In place of the spec of what cannot be a module's name.
NOT_A_NAME = ModuleSpec("", None)


def import_plugins(modules: str | Iterable[str] | None) -> None:
    """Import the modules that the setting `plugins` names; they add parts by `@REGISTRY.register`.

    Args:
        modules: their names; one string is one module.

    Raises:
        ModuleNotFoundError: a module is not on Python's path.
        ImportError: a module does not import; the message names it.
        PermissionError: a module that is not a plugin.
    """
    check_plugins(modules)
    for module in names(modules):
        with importing(f"The plugin module {module!r} (setting 'plugins')"):
            import_module(module)


def check_plugins(modules: str | Iterable[str] | None) -> None:
    """Check the modules that the setting `plugins` names, without importing any.

    A setting can come from a file of somebody else, so only a module that was written for mvrecon
    is imported: one with a line that imports mvrecon. The file is read before any of it runs.

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
        if not _imports_mvrecon(spec):
            raise PermissionError(
                f"The setting 'plugins' names {shown(module)}; expected a module on Python's path "
                f"whose own source imports mvrecon"
            )


def names(modules: str | Iterable[str] | None) -> list[str]:
    """The module names in the setting `plugins`."""
    return [modules] if isinstance(modules, str) else [str(module) for module in modules or ()]


def _imports_mvrecon(spec: ModuleSpec) -> bool:
    if not spec.origin or not spec.origin.endswith(".py"):
        return False
    return IMPORT.search(Path(spec.origin).read_text(encoding="utf-8")) is not None
