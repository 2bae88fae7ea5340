"""Write files atomically, create new folders, and lock a folder for one process."""

import os
import socket
import stat
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import count
from pathlib import Path
from tempfile import TemporaryFile

try:
    import fcntl
except ImportError:  # Windows has no such locks: folders are not locked there
    fcntl = None

LOCK, PART = ".lock", ".part"


@contextmanager
def written_whole(path: str | Path, previous: Path | None = None) -> Iterator[Path]:
    """Context with a temporary path that replaces `path` once all is written; a crash leaves the
    old file.

    The contents reach the disk before the name does, so a power loss cannot leave half a file. The
    temporary file of a killed process, `.<name>.<process>.part`, is removed by the next `claimed`.

    Args:
        path: of the file.
        previous: new path of an existing file; None: deleted. At any moment one of both paths holds
            a complete file.

    Raises:
        OSError: no space, no permission; the message names `path`.
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_name(f".{path.name}.{os.getpid()}{PART}")
    try:
        yield part
        _flush(part, os.O_RDWR)
        if previous is not None and path.exists():
            os.replace(path, previous)
        os.replace(part, path)
        if os.name == "posix":
            _flush(path.parent, os.O_RDONLY)
    except OSError as error:
        if error.filename is None and error.errno is not None:
            raise OSError(error.errno, error.strerror, str(path)) from error
        raise
    finally:
        part.unlink(missing_ok=True)


def check_writable(path: Path) -> None:
    """Check that a file can be written at a path, whose folder may not exist yet, without leaving
    anything there.

    Raises:
        OSError: the path is a folder, no permission, no space; the message names the path.
    """
    if path.is_dir():
        raise IsADirectoryError(f"{path}: expected a file, got a folder")
    nearest = next(folder for folder in path.absolute().parents if os.path.exists(folder))
    try:
        with TemporaryFile(dir=nearest):
            pass
    except OSError as error:
        raise type(error)(
            f"{path}: expected a place that can be written, got {nearest}: {error.strerror}"
        ) from error


@contextmanager
def claimed(folder: Path) -> Iterator[None]:
    """Context that locks a folder for this process, and deletes incomplete files of killed
    processes in it.

    The lock ends with the process, however that ends; worker processes do not inherit it.

    Raises:
        RuntimeError: another process holds the lock; the message names it.
        PermissionError: the folder holds anything but files and folders; see `check_plain`.
    """
    folder.mkdir(parents=True, exist_ok=True)
    check_plain(folder)
    with open(folder / LOCK, "a+", encoding="utf-8") as lock:
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
        for part in folder.rglob(f".*.[0-9]*{PART}"):
            part.unlink(missing_ok=True)
        yield


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
