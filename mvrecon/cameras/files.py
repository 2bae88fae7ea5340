"""Rigs in files: the canonical record as JSON, in mm, one camera a line."""

import json
import math
import os
from pathlib import Path
from typing import Any

from mvrecon.cameras.camera import VECTORS, Cameras

FORMAT = "mvrecon.cameras"
VERSION = 1


def save(cameras: Cameras, path: str | Path) -> None:
    """Write a rig as JSON, whole or not at all; `from_file` gives back the very same numbers."""
    path = Path(path)
    vectors = {name: getattr(cameras, name).tolist() for name in VECTORS}
    lines = [json.dumps({name: vectors[name][m] for name in VECTORS}) for m in range(len(cameras))]
    head = {
        "format": FORMAT,
        "version": VERSION,
        "unit": "mm",
        "shape": list(cameras.shape),
        "parallel": cameras.parallel,
        "extent": cameras.extent,
        "cameras": [],
    }
    text = json.dumps(head, indent=1).replace("[]", "[\n  " + ",\n  ".join(lines) + "\n ]")
    partial = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        partial.write_text(text + "\n", encoding="utf-8")
        partial.replace(path)
    finally:
        partial.unlink(missing_ok=True)


def from_file(path: str | Path) -> Cameras:
    """A rig from a JSON file that `mvrecon.cameras.files.save` wrote, or that follows its layout.

    Layout: {"format": "mvrecon.cameras", "version": 1, "unit": "mm", "shape": [rows, columns], "parallel": false,
    "extent": "segment", "cameras": [{"source": [x, y, z], "origin": [..], "u": [..], "v": [..]}, ..]}; the meaning of
    each is that of `Cameras`.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: truncated or not such a file, entries missing or not finite, or a rig that `Cameras` refuses.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(
            f"There is no camera file {path}; expected JSON as mvrecon.cameras.files.save writes it"
        )
    try:
        record = json.loads(path.read_text(encoding="utf-8"))
    except ValueError as error:  # not UTF-8, or not JSON
        raise ValueError(f"The camera file {path} is truncated or not JSON: {error}") from error
    try:
        return _cameras(record)
    except ValueError as error:
        raise ValueError(f"The camera file {path} is not valid: {error}") from error


def _cameras(record: Any) -> Cameras:
    found = record.get("format") if isinstance(record, dict) else type(record).__name__
    if found != FORMAT:
        raise ValueError(f"expected the format {FORMAT!r}, got {found!r}")
    for key, value in {"version": VERSION, "unit": "mm"}.items():
        if record.get(key) != value:
            raise ValueError(f"expected the {key} {value!r}, got {record.get(key)!r}")
    shape, parallel, extent, rows = (record.get(key) for key in ("shape", "parallel", "extent", "cameras"))
    if not (isinstance(shape, list) and all(type(n) is int for n in shape)):
        raise ValueError(f"expected 'shape' as [rows, columns], got {shape!r}")
    if not isinstance(parallel, bool):
        raise ValueError(f"expected 'parallel' as true or false, got {parallel!r}")
    if not isinstance(rows, list) or not rows:
        raise ValueError(f"expected 'cameras' as a list of at least one, got {rows!r}")
    vectors = {name: [_vector(row, name, m) for m, row in enumerate(rows)] for name in VECTORS}
    return Cameras(**vectors, shape=tuple(shape), parallel=parallel, extent=extent)  # type: ignore[arg-type]


def _vector(row: Any, name: str, m: int) -> list[float]:
    vector = row.get(name) if isinstance(row, dict) else None
    if isinstance(vector, list) and len(vector) == 3 and all(type(x) in (int, float) for x in vector):
        if all(math.isfinite(x) for x in vector):
            return vector
    raise ValueError(f"expected {name!r} of camera {m} as three finite mm, got {vector!r}")
