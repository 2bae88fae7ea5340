"""Variable-length texts of an HDF5 file, read in a separate process with limited memory and time.

libhdf5 2.0 trusts the lengths and heaps of such texts: a damaged file requests gigabytes, or loops
forever. Files written by mvrecon have fixed-length texts instead.
"""

import json
import subprocess
import sys
import time
from pathlib import Path

import h5py

#: Limits of the process: bytes; seconds of computing; seconds in all, for a slow disk.
MEMORY_BYTES, CPU_SECONDS, WALL_SECONDS = 2 * 2**30, 1, 60


def variable(dtype: object) -> bool:
    """Whether values of a type are texts of variable length."""
    text = h5py.check_string_dtype(dtype)
    return text is not None and text.length is None


def texts_of(path: Path, *places: str) -> dict[str, list[str]]:
    """Return texts of a file by their places.

    Args:
        path: path of the file.
        places: "<data set>@<attribute>", or "<data set>@" for the text that it is. None: the
            attributes of the file that are one text each, "@<name>", and its dataset `id` of texts.

    Raises:
        ValueError: the process exceeded its limits, or the file is damaged.
    """
    command = [sys.executable, "-P", __file__, str(path), *places]
    try:
        done = subprocess.run(command, capture_output=True, timeout=WALL_SECONDS, check=False)
    except subprocess.TimeoutExpired as error:
        raise ValueError(f"its texts cannot be read within {WALL_SECONDS} s") from error
    if done.returncode:
        last = done.stderr.decode(errors="replace").strip().splitlines()[-1:]
        raise ValueError(
            f"its texts cannot be read: {''.join(last) or f'exit status {done.returncode}'}"
        )
    return json.loads(done.stdout)


def read(path: str, *places: str) -> dict[str, list[str]]:
    """Read the texts in this process, which `texts_of` starts."""
    with h5py.File(path, "r", locking="best-effort") as file:
        if places:
            texts = {}
            for place in places:
                name, _, attribute = place.partition("@")
                value = file[name].attrs[attribute] if attribute else file[name][()]
                ones = value.ravel() if hasattr(value, "ravel") else [value]
                texts[place] = [o.decode() if isinstance(o, bytes) else str(o) for o in ones]
            return texts
        kinds = {name: file.attrs.get_id(name) for name in list(file.attrs)[:64]}
        short = [name for name, kind in kinds.items() if kind.shape == () and variable(kind.dtype)]
        texts = {f"@{name}": [str(file.attrs[name])] for name in short}
        names = file["id"] if isinstance(file.get("id", getlink=True), h5py.HardLink) else None
        if isinstance(names, h5py.Dataset) and variable(names.dtype):
            texts["id"] = [text.decode() for text in names[:]]
        return texts


def limit() -> None:
    """Limit the memory (bytes) and the computing time (s) of this process."""
    if sys.platform != "win32":
        import resource

        resource.setrlimit(resource.RLIMIT_AS, (MEMORY_BYTES, MEMORY_BYTES))
        computing = int(time.process_time()) + 1 + CPU_SECONDS
        resource.setrlimit(resource.RLIMIT_CPU, (computing, computing))
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))


if __name__ == "__main__":
    limit()
    sys.stdout.write(json.dumps(read(*sys.argv[1:])))
