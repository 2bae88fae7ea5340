"""Plugins as an installer leaves them, for as long as it takes to look at what they do."""

import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from importlib import invalidate_caches
from pathlib import Path

from mvrecon.core.registry import GROUP, installed


@contextmanager
def plugin(
    folder: Path,
    points: Mapping[str, str],
    modules: Mapping[str, str] | None = None,
    name: str = "stressed",
) -> Iterator[None]:
    """A distribution with entry points for mvrecon, on Python's path meanwhile.

    Args:
        folder: where it is put.
        points: what it declares, "<kind>.<name>" -> "module:attribute".
        modules: its modules, name -> source.
        name: of the distribution; two of one name are one.
    """
    about = folder / f"{name}-1.0.dist-info"
    about.mkdir(parents=True)
    (about / "METADATA").write_text(
        f"Metadata-Version: 2.1\nName: {name}\nVersion: 1.0\n", encoding="utf-8"
    )
    lines = [f"[{GROUP}]", *(f"{point} = {where}" for point, where in points.items()), ""]
    (about / "entry_points.txt").write_text("\n".join(lines), encoding="utf-8")
    for module, source in (modules or {}).items():
        (folder / f"{module}.py").write_text(source, encoding="utf-8")
    sys.path.insert(0, str(folder))
    _forget(modules or {})
    try:
        yield
    finally:
        sys.path.remove(str(folder))
        _forget(modules or {})


def _forget(modules: Mapping[str, str]) -> None:
    for module in modules:
        sys.modules.pop(module, None)
    invalidate_caches()
    installed.cache_clear()
