"""Counts behind an ideal knife-edge pinhole.

Along a detector pixel's line through the pinhole, the growth of the seen tube with r^2 cancels the
1/r^2 of each point's solid angle, so a ray-driven projector has no factor of distance: with lambda
in counts / mm^3,

    counts(u, v) = d^2 cos^4(phi) du dv / (16 l^2) * integral of lambda along the line on the
    object's side,

phi the angle from the pinhole's axis, l the distance from pinhole to detector, d the pinhole's
diameter. Integrated over the detector this is a point source's d^2 cos^3(phi) / (16 h^2), h its
distance from the pinhole's plane: Van Audenhaege et al., Med. Phys. 42 (2015) 4796.
"""

from functools import partial
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from mvrecon.cameras.camera import Cameras
from mvrecon.geometry.grid import Grid
from mvrecon.projectors.drr import Drr
from mvrecon.projectors.operator import Scaled


class Spect(Scaled):
    """Counts behind ideal pinholes, without attenuation and blur: volumes [b c d h w] in counts /
    mm^3 to views [b c m v u] in counts.

    The line integrals of `drr` times each pixel's sensitivity, so that ordered subsets, lists of
    rays (bins that hold counts), crops, supports and a rig's mirror symmetry cost what they cost
    with `drr`.

    Args:
        grid: where the activity lies.
        cameras: pinholes, each with its detector behind it and at a right angle to its axis.
        diameter_mm: the pinholes' (effective) diameter.
        options: those of `drr`.

    Raises:
        ValueError: cameras whose detectors are not behind a pinhole, or a diameter that is not
            positive.
    """

    def __init__(self, grid: Grid, cameras: Cameras, diameter_mm: float = 2.3, **options: Any):
        if cameras.extent != "behind" or cameras.parallel:
            kind = "parallel" if cameras.parallel else cameras.extent
            raise ValueError(
                f"Pinhole SPECT needs central cameras of extent 'behind', got {kind!r}"
            )
        if not diameter_mm > 0:
            raise ValueError(f"A pinhole's diameter must be positive mm, got {diameter_mm}")
        A = Drr(grid, cameras, **options)
        weight = partial(sensitivity, cameras, float(diameter_mm))
        super().__init__(A, weight)
        self.diameter_mm = float(diameter_mm)


def sensitivity(cameras: Cameras, diameter_mm: float) -> Float[Tensor, "m v u"]:
    """Sensitivity of each pixel, d^2 cos^4(phi) du dv / (16 l^2) in mm^2: counts per integral."""
    start, end = cameras.rays()
    distance = cameras.distance[:, None, None]
    cosine = distance / (end - start).norm(dim=-1)
    area = torch.linalg.cross(cameras.u, cameras.v).norm(dim=-1)[:, None, None]
    return diameter_mm**2 * cosine**4 * area / (16 * distance**2)
