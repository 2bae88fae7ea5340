"""Modules of the user's own that the setting `plugins` names."""

import ast
from collections.abc import Iterable
from importlib import import_module
from pathlib import Path

from mvrecon.files.checks import shown
from mvrecon.registry import importing, locate


def import_plugins(modules: Iterable[str]) -> None:
    """Import the modules that the setting `plugins` names; they add parts by `@REGISTRY.register`.

    A setting can come from anywhere, so only a module that was written for mvrecon is imported: one
    whose source, read and not run, imports it.

    Raises:
        ImportError: a module does not import; the message names it.
        PermissionError: a module that is not a plugin.
    """
    for module in modules:
        if not _for_mvrecon(module):
            raise PermissionError(
                f"The setting 'plugins' names {shown(module)}; expected a module on Python's path "
                f"whose own source "
                "imports mvrecon"
            )
        with importing(f"The plugin module {module!r} (setting 'plugins')"):
            import_module(module)


def _for_mvrecon(module: str) -> bool:
    if not all(part.isidentifier() for part in str(module).split(".")):
        return False
    spec = locate(module)
    if spec is None or not spec.origin or not spec.origin.endswith(".py"):
        return False
    nodes = list(ast.walk(ast.parse(Path(spec.origin).read_text(encoding="utf-8"))))
    names = [alias.name for node in nodes if isinstance(node, ast.Import) for alias in node.names]
    names += [
        node.module or "" for node in nodes if isinstance(node, ast.ImportFrom) and not node.level
    ]
    return any(name.split(".")[0] == "mvrecon" for name in names)
