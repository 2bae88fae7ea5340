"""SHA-256 digests of a run's inputs: the rig, the files of its scenes and projector, and the
training volumes."""

import hashlib
import json
import os
import re
import sys
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

from jaxtyping import Float
from torch import Tensor

from mvrecon.core.files.checks import Refused, decoded
from mvrecon.geometry.cameras.camera import VECTORS, Cameras
from mvrecon.geometry.grid import Grid

RIG_KEY = "rig"
#: Significant decimals of a mm, so that processors' different sines give the same rig.
SIGNIFICANT_DECIMALS = 9
#: Most bytes of a text header that are searched, and what its lines state behind = or a colon; no
#: line with a NUL, which is none of text.
HEADER = 2**16
STATED = re.compile(r"^[^=:\n\0]*[=:]=?[ \t]*([^\s\0][^\n\0]*?)\s*$", re.MULTILINE)

#: Top packages whose code `of_code` leaves out.
LIBRARIES = {"mvrecon", "torch", *sys.stdlib_module_names} - {"__main__"}


def of_rig(cameras: Cameras) -> str:
    """Digest of a camera record: sources, origins, steps u and v in mm, shape, kind of beam,
    extent.
    """
    vectors = {name: _rounded(getattr(cameras, name).tolist()) for name in VECTORS}
    record = {
        **vectors,
        "shape": list(cameras.shape),
        "parallel": cameras.parallel,
        "extent": cameras.extent,
    }
    return hashlib.sha256(json.dumps(record, sort_keys=True).encode()).hexdigest()


def of_grid(grid: Grid) -> str:
    """Digest of a grid: its shape and its affine in mm."""
    record = {"shape": list(grid.shape), "affine": _rounded(grid.affine.tolist())}
    return hashlib.sha256(json.dumps(record, sort_keys=True).encode()).hexdigest()


def of_volume(volume: Float[Tensor, "*c d h w"]) -> str:
    """Digest of a volume's float32 values, which identifies a case under any name."""
    values = volume.detach().cpu().float().contiguous().numpy()
    return hashlib.sha256(values.tobytes()).hexdigest()


def of_file(path: str | Path) -> str:
    """Digest of a file's bytes, with those of the files that it states as a header, such as the
    values of .mhd, .hv and .vgi; of a folder, of all files below it, also by links, and their
    names.

    Raises:
        OSError: it cannot be read.
    """
    path = Path(path)
    if path.is_dir():
        digests = {f.relative_to(path).as_posix(): _of_bytes(f) for f in sorted(_below(path))}
        return hashlib.sha256(json.dumps(digests).encode()).hexdigest()
    if stated := _stated_in(path):
        whole = [_of_bytes(file) for file in (path, *stated)]
        return hashlib.sha256(json.dumps(whole).encode()).hexdigest()
    return _of_bytes(path)


def of_parts(*parts: Any) -> dict[str, str]:
    """Digests of the code that defines parts and their base classes; see `of_code`."""
    kinds = (kind for part in parts for kind in getattr(part, "__mro__", (part,)))
    return of_code({kind.__module__ for kind in kinds})


def of_code(modules: Iterable[str]) -> dict[str, str]:
    """Digests of the files of imported modules, or of the packages that they are in, by name: all
    files of a package; of a module outside of packages also the modules beside it that are
    imported. A release of mvrecon is identified by its version, and a notebook has no file.
    """
    found = {}
    for name in modules:
        top = name.partition(".")[0]
        if top in LIBRARIES:
            continue
        name = top if _place(top) else name  # namespace packages have no file
        if path := _place(name):
            whole = json.dumps([_of_bytes(file) for file in sorted(_code(path))])
            found[name] = hashlib.sha256(whole.encode()).hexdigest()
    return found


def _place(module: str) -> Path | None:
    """The file of an imported module, if it has one."""
    file = getattr(sys.modules.get(module), "__file__", None)
    return file and Path(file)


def _code(path: Path) -> set[Path]:
    """The files of a module or, by its __init__.py, of a package; no hidden or compiled ones."""
    if path.stem != "__init__":
        modules = [getattr(module, "__dict__", {}) for module in [*sys.modules.values()]]
        loaded = {names.get("__file__") for names in modules}
        return {path, *(file for file in path.parent.glob("*.py") if str(file) in loaded)}
    below = {file: file.relative_to(path.parent).parts for file in path.parent.rglob("*")}
    return {
        file
        for file, parts in below.items()
        if file.is_file() and not any(part.startswith((".", "__pycache__")) for part in parts)
    }


def _of_bytes(path: Path) -> str:
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _below(folder: Path, above: tuple[Path, ...] = ()) -> Iterator[Path]:
    """The files below a folder, through links, except those that lead back to where it is."""
    if (real := folder.resolve()) in above:
        return
    for item in folder.iterdir():
        if item.is_dir():
            yield from _below(item, (*above, real))
        elif item.is_file():
            yield item


def _stated_in(path: Path) -> list[Path]:
    """The other files that the lines of text in a file state, by their paths from its folder."""
    with open(path, "rb") as file:
        head = file.read(HEADER)
    values = STATED.findall(decoded(head))
    places = [path.parent / value for value in dict.fromkeys(values)]
    return [place for place in places if os.path.isfile(place) and place != path]


def files_in(settings: Any, key: str = "") -> Iterator[str]:
    """The files and folders that a part's settings name: existing files of any option, such as an
    attenuation map, or of a list; existing folders of an option `path`, or by an absolute path.

    Args:
        settings: settings, or the value of one.
        key: name of the option whose value it is.
    """
    if isinstance(settings, Mapping):
        for name, value in settings.items():
            yield from files_in(value, name)
    elif isinstance(settings, list | tuple):
        for item in settings:
            yield from files_in(item, key)
    elif isinstance(settings, str | os.PathLike) and (
        os.path.isfile(settings)
        or ((key == "path" or os.path.isabs(settings)) and os.path.isdir(settings))
    ):
        yield os.fspath(settings)


def compare(got: Mapping[str, str], expected: Mapping[str, str], where: str | Path) -> None:
    """Compare the digests that both mappings have, of the rig or of a file by its path.

    Args:
        got: digests of the current inputs.
        expected: recorded digests of a run.
        where: the record, for the message.

    Raises:
        Refused: one differs.
    """
    changed = [name for name in got if name in expected and got[name] != expected[name]]
    if changed:
        values = "; ".join(
            f"{name}: got sha256 {got[name][:16]}, expected {expected[name][:16]}"
            for name in changed
        )
        raise Refused(
            f"The inputs of this run have changed since, according to {where}: {values}. Restore "
            f"them"
        )


def _rounded(value: Any) -> Any:
    return (
        [_rounded(item) for item in value]
        if isinstance(value, list)
        else round(value, SIGNIFICANT_DECIMALS) + 0.0
    )
