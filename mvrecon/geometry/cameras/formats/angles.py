"""Rigs about the z axis as a CSV table: angle, distances, offsets and tilts of each view."""

import csv
from collections.abc import Mapping
from io import StringIO
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from mvrecon.core.files.checks import file_errors, text_of
from mvrecon.core.registry import hint
from mvrecon.geometry.cameras.camera import Cameras
from mvrecon.geometry.cameras.formats import common
from mvrecon.geometry.cameras.rigs import Detector, DetectorOptions
from mvrecon.geometry.rigid import euler_rotation, look_at, unit

#: The table's columns and their defaults; None: required, in the table or as an option.
COLUMNS: dict[str, float | None] = {
    "angle_degrees": None,
    "sid_mm": None,
    "sdd_mm": None,
    "offset_u_mm": 0.0,
    "offset_v_mm": 0.0,
    "tilt_degrees": 0.0,
    "swivel_degrees": 0.0,
    "slant_degrees": 0.0,
    "height_mm": 0.0,
}


def read(
    path: str | Path,
    detector: DetectorOptions,
    sid_mm: float | None = None,
    sdd_mm: float | None = None,
    clockwise: bool = False,
    small_arc: bool = False,
    flip_rows: bool = False,
) -> Cameras:
    """Cone-beam rig in mm from a CSV table of angles in degrees, distances, offsets and tilts.

    The first line names the columns. `angle_degrees` is required; `sid_mm` and `sdd_mm` are columns
    or options; optional are `offset_u_mm`, `offset_v_mm` (shift of the detector to the right and
    downwards as seen from the source, added to the detector's own), `tilt_degrees`,
    `swivel_degrees`, `slant_degrees` (rotations of the detector about its centre: about the beam, u
    towards v; about v; about u) and `height_mm` (source and detector along z).

    Args:
        path: path of the CSV.
        detector: options of `Detector`: pixels, pixel_mm, offset_mm, each (v, u).
        sid_mm: mm from the source to the axis, if not a column.
        sdd_mm: mm from the source to the detector's centre, if not a column.
        clockwise: angles count clockwise as seen from +z.
        small_arc: the angles are degrees although they look like radians.
        flip_rows: the views' first row is the lowest one; their rows must be reversed.

    Convention: as `rigs.circular`: the source at (sid cos a, sid sin a, height); detector axes are
    R_z(tilt) R_y(swivel) R_x(slant) of (right, down, forward).

    Raises:
        OSError: the file cannot be read.
        ValueError: an invalid table, non-finite values, angles in radians, SID > SDD.
    """
    with file_errors(path, "is not a table of angles", "expected a CSV with a line of names"):
        table = _table(text_of(path), {"sid_mm": sid_mm, "sdd_mm": sdd_mm})
        common.check_degrees(table["angle_degrees"].tolist(), small_arc, "angle_degrees")
        common.check_distances(table["sid_mm"], table["sdd_mm"])
        return _cameras(table, Detector.of(detector), -1 if clockwise else 1)


def _cameras(table: dict[str, Tensor], detector: Detector, turn: int) -> Cameras:
    a = torch.deg2rad(turn * table["angle_degrees"])
    outwards = torch.stack([a.cos(), a.sin(), torch.zeros_like(a)], dim=-1)
    up = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    source = table["sid_mm"][:, None] * outwards
    R = look_at(source, torch.zeros_like(source))
    lift = table["height_mm"][:, None] * up
    shift = table["offset_u_mm"][:, None] * R[:, 0] + table["offset_v_mm"][:, None] * R[:, 1]
    centre = source - table["sdd_mm"][:, None] * outwards + shift + lift
    turns = [table[f"{name}_degrees"] for name in ("tilt", "swivel", "slant")]
    E = euler_rotation(torch.stack(turns, dim=-1), "zyx")
    return detector.carried(source + lift, centre, E.mT @ R)


def _table(text: str, options: Mapping[str, float | None]) -> dict[str, Float[Tensor, " m"]]:
    """Return all columns of `COLUMNS`, with one value for each view."""
    lines = list(csv.reader(StringIO(text), strict=True, skipinitialspace=True))
    lines = [[word.strip() for word in line] for line in lines if any(map(str.strip, line))]
    names, *rows = lines or [[]]
    for name in names:
        if name not in COLUMNS:
            raise ValueError(f"expected known columns, got {name!r}{hint(name, COLUMNS)}")
    if len(set(names)) < len(names):
        raise ValueError(f"expected every column once, got {names}")
    if not 0 < len(rows) <= common.VIEWS or any(len(row) != len(names) for row in rows):
        raise ValueError(
            f"expected 1 to {common.VIEWS} lines of {len(names)} numbers below the names"
        )
    table = {}
    for name, absent in COLUMNS.items():
        value = options.get(name)
        if name in names and value is not None:
            raise ValueError(f"expected {name} in the table or as an option, got it in both")
        if name not in names and value is None and absent is None:
            raise ValueError(f"expected {name}, a column of the table or an option, got {names}")
        column = [absent if value is None else float(value)] * len(rows)
        if name in names:
            texts = [row[names.index(name)] for row in rows]
            column = [common.number(text, f"{name} of view {m}") for m, text in enumerate(texts)]
        table[name] = torch.tensor(column, dtype=torch.float64)
    return table


def write(cameras: Cameras, path: str | Path) -> None:
    """Write a cone-beam rig as a table of angles in degrees and lengths in mm, for `read`.

    All offsets are in the table: `read` it with a detector of offset_mm 0.

    Raises:
        OSError: the file cannot be written.
        ValueError: parallel beams, pinholes, detectors that are not rectangular or differ, a source
            on the axis, SID > SDD.
    """
    common.check_cone(cameras, "a table of angles")
    common.square_pixels(cameras, "A table of angles")
    source, forward = cameras.source, unit(torch.linalg.cross(cameras.u, cameras.v))
    flat = source * source.new_tensor([1, 1, 0])
    R = look_at(flat, torch.zeros_like(flat))
    right, down, depth = (
        (R * (cameras.detector_centre - source)[:, None]).sum(dim=-1).unbind(dim=-1)
    )
    axes = torch.stack([unit(cameras.u), unit(cameras.v), forward], dim=1)
    common.check_distances(flat.norm(dim=-1), depth)
    E = R @ axes.mT
    turns = (
        torch.atan2(E[:, 1, 0], E[:, 0, 0]),
        torch.asin((-E[:, 2, 0]).clamp(-1, 1)),
        torch.atan2(E[:, 2, 1], E[:, 2, 2]),
    )
    angle = torch.atan2(source[:, 1], source[:, 0])
    degrees = [torch.rad2deg(turn) for turn in (angle, *turns)]
    degrees[0] = degrees[0].new_tensor(common.unmistakable(degrees[0].tolist()))
    columns = [degrees[0], flat.norm(dim=-1), depth, right, down, *degrees[1:], source[:, 2]]
    common.save_lines(path, ",".join(COLUMNS), torch.stack(columns, dim=-1).tolist(), ",")
