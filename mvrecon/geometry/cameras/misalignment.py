"""Misalignments of a rig: detectors shifted and turned, sources shifted, known or at random."""

from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from mvrecon.geometry.cameras.camera import Cameras
from mvrecon.geometry.rigid import unit


class Misalignment(NamedTuple):
    """What is wrong with each view of a rig, in the detector's own axes.

    Args:
        offset_px: shift of the detector along its columns' and its rows' direction (u, v), in
            pixels.
        tilt_degrees: rotation vector of the detector about its middle, about u, v and the beam (u
            towards v).
        source_mm: shift of the source along u, v and the beam.
        depth_mm: shift of the detector along the beam.
    """

    offset_px: Float[Tensor, "#m 2"]
    tilt_degrees: Float[Tensor, "#m 3"]
    source_mm: Float[Tensor, "#m 3"]
    depth_mm: Float[Tensor, "#m 1"]

    @classmethod
    def none(cls, views: int) -> "Misalignment":
        """A rig as it should be, in float64."""
        return cls(*torch.zeros(views, 9, dtype=torch.float64).split((2, 3, 3, 1), dim=-1))


def misaligned(cameras: Cameras, by: Misalignment) -> Cameras:
    """Cameras with detectors and sources misaligned in pixels, degrees and mm; differentiable in
    the misalignment.

    The detector turns about its middle, then shifts along its old axes.

    Raises:
        ValueError: parallel beams, which have no source.
    """
    if cameras.parallel:
        raise ValueError("expected central cameras to misalign, got parallel beams")
    rows, columns = cameras.shape
    right, down = unit(cameras.u), unit(cameras.v)
    axes = torch.stack([right, down, unit(torch.linalg.cross(cameras.u, cameras.v))], dim=1)
    turn = axes.mT @ _rotation(torch.deg2rad(by.tilt_degrees)) @ torch.linalg.inv(axes.mT)
    u, v = ((turn @ step[..., None])[..., 0] for step in (cameras.u, cameras.v))
    shift = by.offset_px[:, :1] * cameras.u + by.offset_px[:, 1:] * cameras.v
    centre = cameras.detector_centre + shift + by.depth_mm * axes[:, 2]
    source = cameras.source + (axes.mT @ by.source_mm[..., None])[..., 0]
    origin = centre - u * (columns - 1) / 2 - v * (rows - 1) / 2
    return Cameras(source, origin, u, v, cameras.shape, extent=cameras.extent)


def perturbed(
    cameras: Cameras,
    offset_px: float = 2.0,
    tilt_degrees: float = 1.0,
    source_mm: float = 1.0,
    seed: int = 0,
) -> Cameras:
    """Cameras misaligned at random, view by view: detector offsets in pixels, tilts in degrees and
    source shifts in mm.

    Args:
        cameras: the ideal rig.
        offset_px, tilt_degrees, source_mm: standard deviation along or about each axis.
        seed: of the random numbers.
    """
    rng = torch.Generator().manual_seed(seed)
    noise = torch.randn(len(cameras), 8, generator=rng, dtype=torch.float64)
    offset, tilt, source = noise.split((2, 3, 3), dim=-1)
    still = torch.zeros(len(cameras), 1, dtype=torch.float64)
    by = Misalignment(offset_px * offset, tilt_degrees * tilt, source_mm * source, still)
    return misaligned(cameras, by)


def _rotation(vector: Float[Tensor, "m 3"]) -> Float[Tensor, "m 3 3"]:
    """Rotations of rotation vectors in radians, smooth at zero."""
    x, y, z = vector.unbind(dim=-1)
    zero = torch.zeros_like(x)
    rows = [torch.stack(row, dim=-1) for row in ((zero, -z, y), (z, zero, -x), (-y, x, zero))]
    return torch.linalg.matrix_exp(torch.stack(rows, dim=-2))
