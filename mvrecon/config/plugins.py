"""Import the user's own modules that the setting `plugins` names."""

import re
from collections.abc import Iterable
from importlib import import_module
from pathlib import Path

from mvrecon.files.checks import shown
from mvrecon.registry import importing, locate

#: A line of Python that imports mvrecon.
IMPORT = re.compile(r"^\s*(from|import(.*,)?)\s+mvrecon\b", re.MULTILINE)


def import_plugins(modules: Iterable[str]) -> None:
    """Import the modules that the setting `plugins` names; they add parts by `@REGISTRY.register`.

    A setting can come from a file of somebody else, so only a module that was written for mvrecon
    is imported: one with a line that imports mvrecon. The file is read before any of it runs.

    Raises:
        ImportError: a module does not import; the message names it.
        PermissionError: a module that is not a plugin.
    """
    for module in modules:
        if not _imports_mvrecon(module):
            raise PermissionError(
                f"The setting 'plugins' names {shown(module)}; expected a module on Python's path "
                f"whose own source imports mvrecon"
            )
        with importing(f"The plugin module {module!r} (setting 'plugins')"):
            import_module(module)


def _imports_mvrecon(module: str) -> bool:
    if not all(part.isidentifier() for part in str(module).split(".")):
        return False
    spec = locate(module)
    if spec is None or not spec.origin or not spec.origin.endswith(".py"):
        return False
    return IMPORT.search(Path(spec.origin).read_text(encoding="utf-8")) is not None
