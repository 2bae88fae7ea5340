"""Rigs in files: the canonical record as JSON, in mm, one camera per line."""

import json
import sys
from pathlib import Path
from typing import Any

from mvrecon.core.files.atomic import write_text
from mvrecon.core.files.checks import Refused, check_file, json_of, shown
from mvrecon.geometry.cameras.camera import VECTORS, Cameras

FORMAT = "mvrecon.cameras"
FORMAT_VERSION = 1
#: Entries of a file.
HEAD, PROPERTIES = ("format", "version", "unit"), ("shape", "parallel", "extent", "cameras")
#: Maximum rows or columns of a detector in a file.
MAX_DETECTOR_PIXELS = 2**16


def save(cameras: Cameras, path: str | Path) -> None:
    """Write a rig as JSON atomically; `from_file` restores the exact numbers."""
    vectors = {name: getattr(cameras, name).tolist() for name in VECTORS}
    lines = [json.dumps({name: vectors[name][m] for name in VECTORS}) for m in range(len(cameras))]
    head = {
        "format": FORMAT,
        "version": FORMAT_VERSION,
        "unit": "mm",
        "shape": list(cameras.shape),
        "parallel": cameras.parallel,
        "extent": cameras.extent,
        "cameras": [],
    }
    text = json.dumps(head, indent=1).replace("[]", "[\n  " + ",\n  ".join(lines) + "\n ]")
    write_text(path, text + "\n")


def from_file(path: str | Path | None) -> Cameras:
    """Read a rig from a JSON file of `mvrecon.geometry.cameras.files.save` or of its layout.

    Layout: {"format": "mvrecon.cameras", "version": 1, "unit": "mm", "shape": [rows, columns],
    "parallel": false, "extent": "segment", "cameras": [{"source": [x, y, z], "origin": [..], "u":
    [..], "v": [..]}, ..]}, with the fields of `Cameras`.

    Args:
        path: path of the file; null: in mvrecon-reconstruct, the rig that the views' own file
            states.

    Returns:
        The rig, in float64 on the CPU.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: a truncated, too large or invalid file, missing or non-finite entries, or an
            invalid rig.

    Examples:
        >>> from mvrecon.geometry.cameras.files import save
        >>> rig = mv.circular(8, sid=200, sdd=300, detector={"pixels": [32, 32], "pixel_mm": 2.0})
        >>> save(rig, "rig.json")
        >>> torch.equal(mv.from_file("rig.json").source, rig.source)
        True
    """
    if path is None:
        raise ValueError("Expected the path of a camera file, got none")
    path = Path(path)
    check_file(path, "JSON as mvrecon.geometry.cameras.files.save writes it")
    try:
        record = json_of(path)
    except (
        ValueError,
        RecursionError,
    ) as error:  # too large, not UTF-8, not JSON, or unlimited nesting
        raise Refused(f"The camera file {path} is truncated or not JSON: {error}") from error
    try:
        return _cameras(record)
    except (ValueError, OverflowError) as error:
        raise Refused(f"The camera file {path} is not valid: {error}") from error


def _cameras(record: Any) -> Cameras:
    layout = record.get("format") if isinstance(record, dict) else type(record).__name__
    if layout != FORMAT:
        raise ValueError(f"expected the format {FORMAT!r}, got {shown(layout)}")
    for key, value in {"version": FORMAT_VERSION, "unit": "mm"}.items():
        if record.get(key) != value:
            raise ValueError(f"expected the {key} {value!r}, got {shown(record.get(key))}")
    shape, parallel, extent, rows = (record.get(key) for key in PROPERTIES)
    if not (
        isinstance(shape, list) and all(type(n) is int and n <= MAX_DETECTOR_PIXELS for n in shape)
    ):
        raise ValueError(
            f"expected 'shape' as [rows, columns], both up to {MAX_DETECTOR_PIXELS}, got "
            f"{shown(shape)}"
        )
    if not isinstance(extent, str):
        raise ValueError(f"expected 'extent' as text, got {shown(extent)}")
    if not isinstance(parallel, bool):
        raise ValueError(f"expected 'parallel' as true or false, got {shown(parallel)}")
    if not isinstance(rows, list) or not rows:
        raise ValueError(f"expected 'cameras' as a list of at least one, got {shown(rows)}")
    inside = [key for row in rows if isinstance(row, dict) for key in row]
    if unknown := {*record, *inside} - {*HEAD, *PROPERTIES, *VECTORS}:
        raise ValueError(f"expected the entries of the layout alone, got {shown(min(unknown))}")
    vectors = {name: [_vector(row, name, m) for m, row in enumerate(rows)] for name in VECTORS}
    return Cameras(**vectors, shape=tuple(shape), parallel=parallel, extent=extent)  # type: ignore[arg-type]


def _vector(row: Any, name: str, m: int) -> list[float]:
    vector = row.get(name) if isinstance(row, dict) else None
    if isinstance(vector, list) and len(vector) == 3:
        # false for nan, inf, and integers past them
        if all(type(x) in (int, float) and abs(x) <= sys.float_info.max for x in vector):
            return vector
    raise ValueError(f"expected {name!r} of camera {m} as three finite mm, got {shown(vector)}")
