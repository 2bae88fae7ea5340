"""Multi-view reconstruction of volumes: operators, classical methods and networks.

Names are imported on first use, so that `import mvrecon` is fast::

    import mvrecon as mv

    A = mv.Drr(mv.Grid.centred(64, spacing=4.0), mv.dcspect80(pixels=[32, 32]))
    volume = mv.sirt(A, A(x), iterations=50)
"""

import ast
from importlib import import_module
from pathlib import Path
from typing import Any

__version__ = "0.2.0.dev0"

#: The module of each name, from the stub that type checkers read.
_DOOR = {
    alias.name: line.module
    for line in ast.parse(Path(__file__).with_suffix(".pyi").read_text()).body
    if isinstance(line, ast.ImportFrom) and line.module
    for alias in line.names
}


def __getattr__(name: str) -> Any:
    if name not in _DOOR:
        from mvrecon.core.registry import hint

        raise AttributeError(f"mvrecon has no {name!r}{hint(name, _DOOR)}")
    return getattr(import_module(_DOOR[name]), name)


def __dir__() -> list[str]:
    return sorted([*_DOOR, "__version__"])
