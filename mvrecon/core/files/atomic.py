"""Write files atomically, create new folders, and lock a folder for one process."""

import errno
import os
import shutil
import socket
import stat
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from fnmatch import fnmatch
from itertools import count
from pathlib import Path
from tempfile import TemporaryFile, mkdtemp

try:
    import fcntl
except ImportError:  # Windows has no such locks: folders are not locked there
    fcntl = None

LOCK_FILE, PART_ENDING = ".lock", ".part"
#: Numbers of the errors of a full disk.
FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)


@contextmanager
def written_whole(path: str | Path, previous: Path | None = None) -> Iterator[Path]:
    """Context with a temporary path that replaces `path` once all is written; a crash leaves the
    old file.

    The contents reach the disk before the name does, so a power loss cannot leave half a file. The
    temporary file of a killed process, `.<name>.<process>.part`, is removed by the next `claimed`.

    Args:
        path: path of the file.
        previous: new path of an existing file; None: deleted. At any moment one of both paths holds
            a complete file.

    Raises:
        OSError: no space, no permission; the message names `path`.
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_name(f".{path.name}.{os.getpid()}{PART_ENDING}")
    try:
        with naming(path):
            yield part
            _flush(part, os.O_RDWR)
            if previous is not None and path.exists():
                os.replace(path, previous)
            os.replace(part, path)
            if os.name == "posix":
                _flush(path.parent, os.O_RDONLY)
    finally:
        part.unlink(missing_ok=True)


def write_text(path: str | Path, text: str) -> None:
    """Write a text file in UTF-8, see `written_whole`."""
    with written_whole(path) as part:
        part.write_text(text, encoding="utf-8")


@contextmanager
def naming(path: Path) -> Iterator[None]:
    """Context in which an OSError that names no file, as of a full disk, names `path`."""
    try:
        yield
    except OSError as error:
        if error.filename is None and error.errno is not None:
            error.filename = str(path)
        raise


def check_writable(path: Path, inputs: Iterable[Path] = ()) -> None:
    """Check that a file can be written at a path, whose folder may not exist yet, without leaving
    anything there.

    Args:
        path: path of the file.
        inputs: files that are not to be written to.

    Raises:
        OSError: the path is a folder, no permission, no space; the message names the path.
        ValueError: the path is an input, also through links.
    """
    if path.resolve() in {one.resolve() for one in inputs}:
        raise ValueError(f"{path}: is an input; expected another --out")
    if path.is_dir():
        raise IsADirectoryError(f"{path}: expected a file, got a folder")
    nearest = _nearest(path)
    if not nearest.is_dir():
        raise NotADirectoryError(f"{nearest}: expected a folder, got a file")
    try:
        with TemporaryFile(dir=nearest):
            pass
    except OSError as error:
        raise type(error)(
            f"{path}: expected a place that can be written, got {nearest}: {error.strerror}"
        ) from error


def check_room(path: Path, size: int) -> None:
    """Check the free space of the file system of a path, which may not exist yet.

    Args:
        path: path to be written.
        size: bytes.

    Raises:
        OSError: less is free; the message names the path and both sizes.
    """
    free = shutil.disk_usage(_nearest(path)).free
    if free < size:
        need, room = (f"{n / 2**20:.4g} MiB" for n in (size, free))
        raise OSError(f"{path}: needs up to {need}, where {room} are free; choose another disk")


def _nearest(path: Path) -> Path:
    """The innermost folder above a path that exists."""
    return next(folder for folder in path.absolute().parents if os.path.exists(folder))


def written_or_kept(path: Path, write: Callable[[Path], None], places: Sequence[Path]) -> None:
    """Write a file whose contents must not be lost; if that fails, write it elsewhere, and raise.

    Args:
        path: path of the file.
        write: writes the file at a path with the same name; raises OSError or, as ITK,
            RuntimeError.
        places: existing folders that are tried in turn; the file goes into a new folder there.

    Raises:
        OSError: the file is not written at `path`; the message names the place where it is kept.
    """
    try:
        return write(path)
    except (OSError, RuntimeError) as error:
        failure = error
    reason = getattr(failure, "strerror", None) or failure
    for place in places:
        try:
            folder = Path(mkdtemp(prefix=f"{path.name}.", dir=place))
        except OSError:
            continue
        try:
            write(folder / path.name)
        except (OSError, RuntimeError):
            shutil.rmtree(folder, ignore_errors=True)
            continue
        raise OSError(
            f"{path}: cannot be written ({reason}); it is kept as {folder / path.name}"
        ) from failure
    raise OSError(
        f"{path}: cannot be written ({reason}), and neither in any of "
        f"{', '.join(map(str, places))}; it is lost"
    ) from failure


@contextmanager
def claimed(folder: Path) -> Iterator[None]:
    """Context that locks a folder for this process, and deletes incomplete files of killed
    processes in it, except below a folder with a lock of its own, whose process may be alive.

    The lock ends with the process, however that ends; worker processes do not inherit it. An error
    of a full disk that names no file, as a logger's, names the folder.

    Raises:
        RuntimeError: another process holds the lock; the message names it.
        PermissionError: the folder holds anything but files and folders; see `check_plain`.
    """
    folder.mkdir(parents=True, exist_ok=True)
    check_plain(folder)
    with open(folder / LOCK_FILE, "a+", encoding="utf-8") as lock:
        if fcntl is not None:
            try:
                fcntl.lockf(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except (BlockingIOError, PermissionError) as error:
                lock.seek(0)
                owner = lock.read().strip() or "another process"
                raise RuntimeError(
                    f"{folder} is in use by {owner}; choose another folder by hydra.run.dir=..."
                ) from error
        lock.truncate(0)
        lock.write(f"process {os.getpid()} on {socket.gethostname()}\n")
        lock.flush()
        for part in [*_parts(folder)]:
            shutil.rmtree(part) if part.is_dir() else part.unlink(missing_ok=True)
        try:
            yield
        except OSError as error:
            if error.filename is None and error.errno in FULL:
                error.filename = str(folder)
            raise


def _parts(folder: Path) -> Iterator[Path]:
    """Incomplete files and folders below a folder, without those of other runs."""
    for path in folder.iterdir():
        if fnmatch(path.name, f".*.[0-9]*{PART_ENDING}"):
            yield path
        elif path.is_dir() and not (path / LOCK_FILE).exists():
            yield from _parts(path)


def new_folder(path: str | Path) -> Path:
    """Create a new folder at a path; if it exists already, with the suffix _2, _3, ...

    Raises:
        OSError: no space, no permission.
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    for number in count(1):
        folder = path if number == 1 else path.with_name(f"{path.name}_{number}")
        try:
            folder.mkdir()  # atomic: only one process succeeds
            break
        except FileExistsError:
            continue
    return folder


def check_plain(folder: Path) -> None:
    """Raise if a folder contains a link, a pipe or a device, at any depth.

    The folder itself may be a link.

    Raises:
        PermissionError: it does; the message names the first.
    """
    for parent, folders, files in os.walk(folder):  # does not follow links
        for path in (Path(parent, name) for name in (*folders, *files)):
            try:
                kind = path.lstat().st_mode
            except FileNotFoundError:  # its writer has just renamed it
                continue
            if not (stat.S_ISREG(kind) or stat.S_ISDIR(kind)):
                raise PermissionError(
                    f"{folder} holds {path.relative_to(folder)}, a link, a pipe or a device; "
                    f"expected files and folders"
                )


def _flush(path: Path, flags: int) -> None:
    descriptor = os.open(path, flags)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
