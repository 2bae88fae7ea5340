"""Rigs as 3x4 projection matrices in a text file, one per view."""

from collections.abc import Sequence
from pathlib import Path

import torch

from mvrecon.core.files.checks import Refused, file_errors
from mvrecon.geometry.cameras.camera import Cameras
from mvrecon.geometry.cameras.convert import from_matrix
from mvrecon.geometry.cameras.formats import common
from mvrecon.geometry.cameras.rigs import Detector, DetectorOptions


def read(
    path: str | Path,
    detector: DetectorOptions,
    first_pixel: float = 0.0,
    centre: Sequence[float] = (0.0, 0.0, 0.0),
    world: str = "RAS",
    flip_rows: bool = False,
) -> Cameras:
    """Cone-beam rig in mm from 3x4 matrices P with P (X, 1) ~ (u, v, 1), u and v in pixels.

    Args:
        path: path of the text file: twelve numbers per line, or three lines of four per view; #
            begins a comment.
        detector: options of `Detector`: pixels and pixel_mm, each (v, u); an offset is P's.
        first_pixel: coordinate of the first pixel's centre in P: 0, 0.5 (corners are integers), or
            1 (MATLAB).
        centre: a point of the object, in mm in the file's axes, between source and detector, which
            determines P's sign.
        world: axes of the file, "RAS", "LPS" or "IEC"; see `to_ras`.
        flip_rows: rows count upwards in P; the rows of the views must be reversed.

    Convention: the scale of P is arbitrary; the detector's distance follows from pixel_mm only.

    Raises:
        OSError: the file cannot be read.
        ValueError: an invalid file, non-finite values, matrices of parallel beams, or left-handed
            ones: rows that run the other way than `flip_rows` states; options that contradict the
            first line that `write` wrote.
    """
    lines, plate = common.number_lines(path), Detector.of(detector)
    common.check_head(path, _head(plate.pixels, world))
    if any(plate.offset_mm):
        raise ValueError(f"expected a detector without offset_mm, which P has, got {plate}")
    if lines and {len(line) for line in lines} == {4} and len(lines) % 3 == 0:
        lines = [sum(lines[row : row + 3], []) for row in range(0, len(lines), 3)]
    P = common.rows_of(path, lines, 12).unflatten(1, (3, 4))
    with file_errors(path, "holds no matrices of a cone beam", "are units and pixels as expected?"):
        P = torch.cat([P[:, :2] - first_pixel * P[:, 2:], P[:, 2:]], dim=1)
        # the sign that puts the centre on the detector's side of the source, and unit scale
        depth = P[:, 2] @ torch.tensor([*centre, 1.0], dtype=torch.float64)
        if not (depth != 0).all():
            raise ValueError("expected a centre that no source's plane goes through")
        P = P * depth.sign()[:, None, None] / P[:, 2:, :3].norm(dim=-1, keepdim=True)
        if flip_rows:
            P = torch.stack([P[:, 0], (plate.pixels[0] - 1) * P[:, 2] - P[:, 1], P[:, 2]], dim=1)
        if (torch.linalg.det(P[:, :, :3]) <= 0).any():
            raise Refused(
                f"{path}: the rows of its matrices run the other way round; expected "
                f"flip_rows={'false' if flip_rows else 'true'} (and the rows of the views with it)"
            )
        pitch = from_matrix(P, plate.pixels, 1.0).u.norm(dim=-1)
        return common.from_world(from_matrix(P, plate.pixels, plate.pixel_mm[1] / pitch), world)


def write(cameras: Cameras, path: str | Path, world: str = "RAS") -> None:
    """Write the 3x4 matrices of a rig, twelve numbers per view, for `read`.

    Raises:
        OSError: the file cannot be written.
        ValueError: parallel beams or pinholes, which `read` does not support, or pixels of several
            widths, from which `read` could not tell the detectors' distances.
    """
    common.check_cone(cameras, "3x4 matrices")
    widths = cameras.u.norm(dim=-1)
    if widths.max() > (1 + 1e-6) * widths.min():
        raise ValueError(
            f"expected pixels of one width for 3x4 matrices, got {widths.min().item():g} to "
            f"{widths.max().item():g} mm; files.save keeps them"
        )
    matrices = common.into_world(cameras, world).matrix.flatten(1).tolist()
    common.save_lines(path, _head(cameras.shape, world), matrices, " ")


def _head(shape: Sequence[int], world: str) -> str:
    """The first line of a file that `write` writes."""
    return (
        f"# 3x4 matrices, row by row: mm ({world}) to pixels, {shape[0]} rows, {shape[1]} columns"
    )
