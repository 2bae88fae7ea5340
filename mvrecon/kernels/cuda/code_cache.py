"""Machine code on disk, so that the next process does not compile it."""

import logging
import os
import stat
from collections.abc import Callable
from hashlib import sha256
from pathlib import Path

from mvrecon.core.files.atomic import written_whole

logger = logging.getLogger(__name__)

#: Bytes of the digest in front of the machine code.
HEAD = 32


def folder() -> Path:
    """Where machine code is: `mvrecon/kernels` in the user's folder for caches."""
    base = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(base) / "mvrecon" / "kernels"


def cached(name: str, build: Callable[[], bytes]) -> bytes:
    """The machine code of a name, from disk, or built and written there; files that do not fit are
    built anew. Nobody but the user may be able to write them.
    """
    path = folder() / f"{name}.bin"
    try:
        if (code := _read(path)) is not None:
            return code
    except OSError as problem:
        logger.warning("Compiled kernels cannot be read, so they are made anew: %s", problem)
        return build()
    code = build()
    try:
        path.parent.mkdir(parents=True, exist_ok=True, mode=0o700)
        with written_whole(path) as part:
            part.write_bytes(sha256(code).digest() + code)
    except OSError as problem:
        logger.warning("Compiled kernels cannot be kept: %s", problem)
    return code


def _read(path: Path) -> bytes | None:
    """Machine code on disk; None: none, or it is damaged.

    Raises:
        PermissionError: another user could have written it.
    """
    if not path.exists():
        return None
    for place in (path.parent, path):
        described = place.stat()
        others = described.st_mode & (stat.S_IWGRP | stat.S_IWOTH)
        if os.name == "posix" and (described.st_uid != os.getuid() or others):
            raise PermissionError(f"{place} belongs to another user, or others may write it")
    content = path.read_bytes()
    code = content[HEAD:]
    return code if sha256(code).digest() == content[:HEAD] else None
