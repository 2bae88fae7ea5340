"""Check untrusted files before use: size, text, names."""

import json
import math
import os
import re
import reprlib
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import numpy as np

#: Maximum bytes of a text file, of a YAML file (whose parser is slow), and of an unpacked volume
#: and chunk of a file.
MAX_TEXT_BYTES, MAX_YAML_BYTES, VOLUME, MAX_CHUNK_BYTES = 16 * 2**20, 64 * 2**10, 8 * 2**30, 2**28
#: Maximum voxels along an axis of a volume from a file.
EDGE = 2**14
#: Maximum bytes of a name; maximum values of a YAML file.
MAX_NAME_BYTES, MAX_YAML_VALUES = 200, 100_000
#: Maximum bytes per byte of a deflate stream: 258 for two bits (RFC 1951).
MAX_DEFLATE_RATIO = 1032
#: Allowed voxel sizes in mm.
SPACING_MM = (1e-6, 1e6)
#: mm in units of length, by their names in lower case; the bytes of a µ in UTF-8 may have been read
#: as Latin-1, and it has two codes.
MILLIMETRES = {"m": 1e3, "cm": 10.0, "mm": 1.0, "um": 1e-3, "nm": 1e-6}
MILLIMETRES |= dict.fromkeys(("micron", "microns", "µm", "μm", "âµm", "î¼m"), 1e-3)
MILLIMETRES |= {
    f"{prefix}met{end}": mm
    for prefix, mm in {"": 1e3, "centi": 10.0, "milli": 1.0, "micro": 1e-3, "nano": 1e-6}.items()
    for end in ("er", "ers", "re", "res")
}


class Refused(ValueError):
    """Error for a damaged file or unexpected contents; the message names the file."""


@contextmanager
def file_errors(
    path: str | Path, what: str, hint: str = "is it cut short or damaged?"
) -> Iterator[None]:
    """Context that converts any error of a library to one that names the file, as damage may raise
    any.

    Raises:
        Refused: instead of any error except `Refused` and missing imports.
    """
    try:
        yield
    except (Refused, ImportError):
        raise
    except Exception as error:
        raise Refused(f"{path}: {what} ({type(error).__name__}: {error}); {hint}") from error


def millimetres(where: object, unit: str) -> float:
    """mm in a unit of length.

    Args:
        where: source of the unit, for the message.
        unit: name of the unit, such as "um", "Micron" or "micrometre".

    Raises:
        Refused: an unknown unit.
    """
    mm = MILLIMETRES.get(unit.strip().lower())
    if mm is None:
        raise Refused(
            f"{where}: expected units of m, cm, mm, um or nm, got {shown(unit)}; convert lengths"
        )
    return mm


def decoded(raw: bytes) -> str:
    """The text of UTF-8 without its byte order mark; bytes that are not UTF-8 are read as Latin-1,
    as older programs of Windows write them.
    """
    text = raw.decode("utf-8-sig", "surrogateescape")
    return re.sub("[\udc80-\udcff]", lambda byte: chr(ord(byte[0]) - 0xDC00), text)


def text_of(path: str | Path, limit: int = MAX_TEXT_BYTES, strict: bool = True) -> str:
    """The UTF-8 text of a file, without the byte order mark that some programs write before it.

    Args:
        path: path of the file.
        limit: most bytes.
        strict: whether bytes that are not UTF-8 are refused, or else `decoded`.

    Raises:
        OSError: it cannot be read.
        Refused: more bytes than `limit`, or not UTF-8 if `strict`.
    """
    with Path(path).open("rb") as file:
        raw = file.read(limit + 1)
    if len(raw) > limit:
        raise Refused(f"{path}: is larger than {limit} bytes, the most that is read of such a file")
    try:
        return raw.decode("utf-8-sig") if strict else decoded(raw)
    except UnicodeDecodeError as error:
        raise Refused(f"{path}: is not UTF-8 text ({error})") from error


def json_of(path: str | Path) -> Any:
    """The content of a JSON file, whose objects state every name once.

    Raises:
        OSError: it cannot be read.
        ValueError: too large, not JSON, or a repeated name, of which Python keeps the last value.
    """

    def unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
        names = [name for name, _ in pairs]
        if repeated := sorted({name for name in names if names.count(name) > 1}):
            raise ValueError(f"expected every name once, got several {shown(repeated[0])}")
        return dict(pairs)

    return json.loads(text_of(path), object_pairs_hook=unique)


def yaml_of(path: str | Path, loader: type | None = None) -> Any:
    """Read the plain values of a YAML file with at most `MAX_YAML_VALUES` values after expanding
    aliases.

    Args:
        path: path of the file.
        loader: a class derived from PyYAML's SafeLoader; None: that itself.

    Raises:
        OSError: it cannot be read.
        Refused: too large, not UTF-8, not YAML, a tag of an object, a repeated name, or an
            explosion of aliases.
    """
    return yaml_in(text_of(path, MAX_YAML_BYTES), path, loader)


def yaml_in(text: str, path: str | Path, loader: type | None = None) -> Any:
    """The plain values of the text of a YAML file, see `yaml_of`.

    Raises:
        Refused: as there.
    """
    import yaml

    with file_errors(path, "is not YAML"):
        reader = (loader or yaml.SafeLoader)(text)
        root = reader.get_single_node()
        if root is not None and _unfolded(root, {}) > MAX_YAML_VALUES:
            raise Refused(f"{path}: unfolds to more than {MAX_YAML_VALUES} values")
        return None if root is None else reader.construct_document(root)


def _unfolded(node: Any, sizes: dict[int, float]) -> float:
    """The number of values of a node after expanding aliases; infinite for a cyclic one.

    Raises:
        ValueError: a repeated name, of which PyYAML keeps the last value.
    """
    if id(node) not in sizes:
        sizes[id(node)] = float("inf")  # until its parts are known
        parts = node.value if isinstance(node.value, list) else []
        names = [str(part[0].value) for part in parts if isinstance(part, tuple)]
        if repeated := sorted({name for name in names if names.count(name) > 1}):
            raise ValueError(f"expected every name once, got several {shown(repeated[0])}")
        flat = [part for pair in parts for part in (pair if isinstance(pair, tuple) else (pair,))]
        sizes[id(node)] = 1 + sum(_unfolded(part, sizes) for part in flat)
    return sizes[id(node)]


def from_home(path: str | os.PathLike[str]) -> Path:
    """A path with `~` as in a shell: the name `~z.nii.gz` stays one where no user is called so."""
    return Path(os.path.expanduser(path))


def file_in(folder: Path, path: str, folders: bool = True) -> Path | None:
    """The absolute path, from a folder, of a file, folder (unless `folders` is false), or data set
    as <file>:<name>; None if there is no such file.
    """
    head, sign, name = path.rpartition(":")
    whole = folder.absolute() / from_home(path)
    if whole.is_file() or (folders and whole.exists()):
        return whole
    place = folder.absolute() / from_home(head)
    return Path(f"{place}:{name}") if sign and place.is_file() else None


def plain_name(name: Any, where: str | Path) -> str:
    """Check that a name is a valid file or folder name, and not a path; return it.

    Args:
        name: name to be checked.
        where: its origin, for the message.

    Raises:
        Refused: not printable text of 1 to 200 bytes, or with / \\ or :, or of dots alone.
    """
    if _plain(name):
        return name
    raise Refused(
        f"{where}: has the name {shown(name)}; expected at most {MAX_NAME_BYTES} bytes of text "
        f"without / \\ and :"
    )


def _plain(name: Any) -> bool:
    text = isinstance(name, str) and name.isprintable() and not set(name) & set("/\\:")
    return text and bool(name.strip(". ")) and len(name.encode()) <= MAX_NAME_BYTES


def file_beside(header: Path, stated: str) -> Path:
    """The file of values that a header states: a relative path in the header's folder or below, or
    the absolute path of a file beside it.

    Raises:
        FileNotFoundError: it does not exist.
        Refused: another path, or one through a link.
    """
    folder = path = header.parent
    if Path(stated).is_absolute() and Path(stated).parent.resolve() == folder.resolve():
        stated = Path(stated).name
    for part in stated.removeprefix("./").split("/"):
        above, path = path, path / part  # a colon is a time on Linux, and a drive on Windows
        if not _plain(part.replace(":", "")) or path.parent != above or path.is_symlink():
            raise Refused(
                f"{header}: expected a file of values in its folder or below, not through a link, "
                f"got {shown(stated)}"
            )
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file; expected the values of {header.name}")
    return path


def check_link(path: Path) -> None:
    """Check that a path is no broken link, as a file that git-annex did not fetch.

    Raises:
        FileNotFoundError: a link whose target is missing.
    """
    if path.is_symlink() and not path.exists():
        raise FileNotFoundError(
            f"{path}: is a link to {path.readlink()}, which is not there; fetch it, or remove "
            f"the link"
        )


def check_file(path: Path, expected: str) -> None:
    """Check that a path is an existing file.

    Raises:
        FileNotFoundError: it does not exist.
        IsADirectoryError: it is a folder.
    """
    if path.is_dir():
        raise IsADirectoryError(f"{path}: is a folder; expected {expected}")
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file; expected {expected}")


def npy_array(path: Path) -> "np.memmap":
    """The one array of a NumPy file, without reading its values.

    Raises:
        FileNotFoundError: nothing is there.
        Refused: no array, Python objects, cut short, or followed by other bytes, as a second array.
    """
    from numpy.lib.format import open_memmap  # takes a tenth of a second

    check_file(path, "a NumPy array")
    with file_errors(path, "cannot be read as a NumPy array"):
        array = open_memmap(path, mode="r")
    expected = array.offset + array.nbytes
    if (got := path.stat().st_size) != expected:
        raise Refused(
            f"{path}: expected one array of {expected} bytes, got {got}; save all views as one "
            f"array"
        )
    return array


def check_declared(
    path: Path,
    shape: Sequence[int],
    itemsize: int,
    data: Path,
    offset: int = 0,
    packed: bool = False,
    working: int = 1,
) -> None:
    """Check a volume's declared size against the file of its values, before allocating memory.

    Args:
        path: path of the header, for the message.
        shape: voxels along each axis.
        itemsize: bytes of a value in the file.
        data: the file with the values.
        offset: position of the first value in the file, in bytes.
        packed: whether the values are deflated.
        working: minimum bytes of a value in memory.

    Raises:
        Refused: more than the file can hold, or than a volume may have.
    """
    needed, room = offset + math.prod(shape) * itemsize, data.stat().st_size
    whole = math.prod(shape) * max(itemsize, working)
    if (
        not 0 <= needed <= room * (MAX_DEFLATE_RATIO if packed else 1)
        or whole > VOLUME
        or max(shape) > EDGE
    ):
        raise Refused(
            f"{path}: cannot be read (it declares {needed} bytes, where {data.name} has {room}, "
            f"and {VOLUME} bytes and {EDGE} voxels along an axis are allowed); is it cut short?"
        )


def io_library(module: str, path: str | Path, extra: str = "io") -> Any:
    """Import a library of an extra.

    Raises:
        ImportError: it is not installed; the message names the file that needs it.
    """
    try:
        return import_module(module)
    except ImportError as error:
        name = module.partition(".")[0]
        raise ImportError(f"{path}: needs {name}: pip install 'mvrecon[{extra}]'") from error


def shown(value: Any) -> str:
    """A short representation of a value from a file, for messages."""
    return reprlib.repr(value)
