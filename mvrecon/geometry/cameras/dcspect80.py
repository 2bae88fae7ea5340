"""The dynamic cardiac SPECT camera of 80 pinholes (DC-SPECT)."""

import csv
from collections.abc import Sequence
from functools import cache
from importlib.resources import files

import torch

from mvrecon.geometry.cameras.camera import Cameras
from mvrecon.geometry.cameras.rigs import Detector
from mvrecon.geometry.rigid import look_at

ROWS, COLUMNS = 4, 20
DETECTOR_MM = 50.0


def dcspect80(
    pixels: int | Sequence[int] = 48,
    rows: Sequence[int] | None = None,
    columns: Sequence[int] | None = None,
    field: float = 1.0,
) -> Cameras:
    """The 80-pinhole cardiac camera DC-SPECT: pinholes about the chest, all aimed at the heart's
    centre, the origin.

    Each detector, 50 x 50 mm, stands one collimator length (50 to 89 mm) behind its pinhole, square
    to the pinhole's axis; v runs downwards, towards -z as far as it can. Camera k of the whole rig
    is module 20 row + column.

    Args:
        pixels: the detector's pixels (rows, columns), or one number for both.
        rows: which of the 4 rows of modules, from -z to +z; all by default.
        columns: which of the 20 columns, from the azimuth 14 degrees on to 256; all by default.
        field: detectors so many times as wide and high, with as many pixels; 2: the enlarged field
            of the project's design slides.

    Published: pinhole positions, detector size, and the collimator lengths of 8 modules (16 with
    the mirror symmetry). Fitted: the other 64 lengths, linear in the distance to the heart. Not
    published: the pixel pitch, hence `pixels`. Source: the header of `dcspect80.csv`, beside this
    file.

    Raises:
        ValueError: a row or a column that the camera does not have, or a field that is not
            positive.
    """
    chosen = [
        20 * row + column
        for row in _chosen("rows", rows, ROWS)
        for column in _chosen("columns", columns, COLUMNS)
    ]
    table = torch.tensor(modules(), dtype=torch.float64)[chosen]
    pinhole, length = table[:, :3], table[:, 3:]
    heart = torch.zeros_like(pinhole)
    centre = pinhole + length * torch.nn.functional.normalize(pinhole, dim=-1)
    if not 0 < field < float("inf"):
        raise ValueError(f"Expected a positive factor of the field, got {field}")
    count = (pixels, pixels) if isinstance(pixels, int) else tuple(pixels)
    detector = Detector.of(
        {"pixels": count, "pixel_mm": [field * DETECTOR_MM / max(n, 1) for n in count]}
    )
    return detector.carried(pinhole, centre, look_at(pinhole, heart), extent="behind")


@cache
def modules() -> tuple[tuple[float, float, float, float], ...]:
    """Pinhole x, y, z and collimator length in mm of the 80 modules, in their order."""
    text = files("mvrecon.geometry.cameras").joinpath("dcspect80.csv").read_text(encoding="utf-8")
    table = csv.DictReader(line for line in text.splitlines() if not line.startswith("#"))
    columns = ("x_mm", "y_mm", "z_mm", "collimator_length_mm")
    return tuple(tuple(float(row[name]) for name in columns) for row in table)  # type: ignore[misc]


def _chosen(what: str, indices: Sequence[int] | None, count: int) -> Sequence[int]:
    if indices is None:
        return range(count)
    if not indices or any(i not in range(count) for i in indices):
        raise ValueError(f"DC-SPECT has {what} 0 to {count - 1}, got {list(indices)}")
    return indices
