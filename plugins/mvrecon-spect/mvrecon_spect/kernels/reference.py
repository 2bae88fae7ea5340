"""Reference implementation of footprints: `project` in plain torch, with derivatives of any order.

The view of a voxel is separable on the detector: weight x (profile along u) x (profile along v). A
profile has the variance and the kurtosis of the projected voxel, convolved with the image of the
hole and the detector's resolution; a pixel receives the difference of its cumulative distribution
between the pixel's edges. Thus the pixel is counted once, and the sum over a detector that holds
the footprint is the weight.
"""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from mvrecon_spect.kernels.profile import (
    COEFFICIENTS,
    PIECES,
    STEPS,
    TERMS,
    VARIANCE,
    VARIANCE_STEP,
)

#: Columns of a rig's record [m c], see `mvrecon_spect.operators.response.record_of`: rows of the
#: map from voxel index (i, j, k, 1) to w (u, v, 1); distance l from hole to detector; effective
#: area of the hole over 4 pi times the voxel's volume; coefficients of 1 / cos^2 by 1, u, v, u^2,
#: uv, v^2; least cosine; pixel (u, v) of the hole's foot; tangent of a pixel; pixels per mm;
#: variance and fourth cumulant of a hole of width one (negated).
OF_U, OF_V, OF_W = slice(0, 4), slice(4, 8), slice(8, 12)
LENGTH, AREA, SECANT, LEAST_COSINE = 12, 13, slice(14, 20), 20
FOOT, TANGENT, PER_MM, HOLE = slice(21, 23), slice(23, 25), slice(25, 27), slice(27, 29)
#: Polynomials 1, m, m^2, t, t m, t m^2 in the magnification m = l / h and t = 1 - cos of the angle
#: to the axis: squared widths of the hole's image along u and v, variance of the
#: detector, further variance per squared tangent along an axis, all in mm^2.
WIDTH_U, WIDTH_V = slice(29, 35), slice(35, 41)
DETECTOR, RADIAL = slice(41, 47), slice(47, 53)
#: Shift in mm per tangent, by 1, t; efficiency by 1, t, t^2.
SHIFT, EFFICIENCY = slice(53, 55), slice(55, 58)
COLUMNS = 58
#: Least distance of a voxel's centre from the pinhole's plane, in depths of the voxel; more than a
#: half, so that rounding does not decide whether a voxel that touches the plane is seen.
BEFORE_PLANE = 0.50001
#: Most voxels at a time.
AT_ONCE = 2**16


class VoxelImages(NamedTuple):
    """Images of p voxels behind one pinhole: weights; and along u and v centres, variances and
    half widths in pixels, and coefficients of the cumulative distributions.
    """

    weight: Float[Tensor, " p"]
    centre: Float[Tensor, "2 p"]
    variance: Float[Tensor, "2 p"]
    half: Float[Tensor, "2 p"]
    coefficients: Float[Tensor, "2 p e"]

    def shares(self, axis: int, pixels: int) -> Float[Tensor, "p n"]:
        """Shares of the pixels along an axis."""
        edges = torch.arange(pixels + 1, device=self.half.device) - 0.5
        t = (edges - self.centre[axis, :, None]) / self.half[axis, :, None]
        t = t.clamp(-1, 1)
        s, total = t * t, self.coefficients[axis, :, TERMS - 1, None]
        for e in range(TERMS - 2, -1, -1):
            total = total * s + self.coefficients[axis, :, e, None]
        return (total * t).diff(dim=1).clamp_min(0)


def project(
    volume: Float[Tensor, "n d h w"],
    rig: Float[Tensor, "m c"],
    detector: Sequence[int],
    transmission: Float[Tensor, "m d h w"] | None = None,
) -> Float[Tensor, "n m v u"]:
    """Counts of volumes.

    Args:
        volume: emission per mm^3.
        rig: the record of each pinhole, see above.
        detector: rows and columns.
        transmission: share of photons that arrive, from each voxel to each pinhole; None: one.
    """
    rows, columns = detector
    flat = volume.flatten(1)
    views = []
    for m, record in enumerate(rig.double()):
        view = flat.new_zeros(len(flat), rows, columns)
        for some, index in voxels_of(volume.shape[1:], rig.device):
            prints = footprints(record, index)
            x = flat[:, some] * prints.weight.to(flat)
            if transmission is not None:
                x = x * transmission[m].flatten()[some].to(flat)
            down, across = (prints.shares(a, n).to(flat) for a, n in ((1, rows), (0, columns)))
            view = view + (x[:, :, None] * down).mT @ across
        views.append(view)
    return torch.stack(views, dim=1)


def voxels_of(
    shape: Sequence[int], device: torch.device
) -> Iterator[tuple[slice, Float[Tensor, "p 4"]]]:
    """Slices of the flattened grid, and the indices (i, j, k, 1) of their voxels along x, y, z."""
    _, height, width = shape
    count = shape[0] * height * width
    for first in range(0, count, AT_ONCE):
        place = torch.arange(first, min(first + AT_ONCE, count), device=device)
        i, j, k = place % width, place // width % height, place // (width * height)
        index = torch.stack([i, j, k, torch.ones_like(i)], dim=1).double()
        yield slice(first, first + len(place)), index


def footprints(record: Float[Tensor, " c"], index: Float[Tensor, "p 4"]) -> VoxelImages:
    """The footprints of voxels at the indices (i, j, k, 1)."""
    to_u, to_v, to_w = record[OF_U], record[OF_V], record[OF_W]
    w = index @ to_w
    # a voxel that the pinhole's plane cuts or touches, or behind it, is not seen
    seen = -w > BEFORE_PLANE * to_w[:3].abs().sum()
    w = torch.where(seen, w, -1.0)
    centre = torch.stack([index @ to_u, index @ to_v]) / w
    tangents = (centre - record[FOOT, None]) * record[TANGENT, None]
    u, v = centre
    ones = torch.ones_like(u)
    secant2 = record[SECANT] @ torch.stack([ones, u, v, u * u, u * v, v * v])
    cosine, m = secant2.rsqrt(), -1 / w
    t = 1 - cosine
    seen = seen & (cosine >= record[LEAST_COSINE])
    powers = torch.stack([ones, m, m * m, t, t * m, t * m * m])
    per_mm2 = record[PER_MM, None] ** 2
    images = torch.stack([record[WIDTH_U] @ powers, record[WIDTH_V] @ powers]) * per_mm2
    blur = (record[DETECTOR] @ powers + record[RADIAL] @ powers * tangents**2) * per_mm2
    squares = edges_of(record, centre, w) ** 2
    variance = squares.sum(dim=1) / 12 + images * record[HOLE][0] + blur
    # a response's polynomials may be negative far beside the detector, where nothing is seen
    seen = seen & (variance > 0).all(dim=0)
    variance = torch.where(variance > 0, variance, 1.0)
    fourth = squares.square().sum(dim=1) / 120 + images**2 * record[HOLE][1]
    half, coefficients = profiles(variance, fourth)
    shift = (record[SHIFT] @ torch.stack([ones, t])) * tangents * record[PER_MM, None]
    efficiency = record[EFFICIENCY] @ torch.stack([ones, t, t * t])
    weight = record[AREA] * efficiency * cosine**3 * (m / record[LENGTH]) ** 2
    return VoxelImages(torch.where(seen, weight, 0.0), centre + shift, variance, half, coefficients)


def edges_of(
    record: Float[Tensor, " c"], centre: Float[Tensor, "2 p"], w: Float[Tensor, " p"]
) -> Float[Tensor, "2 3 p"]:
    """Images in pixels (u, v) of the edges of voxels along x, y, z."""
    to_u, to_v, to_w = (record[some][:3] for some in (OF_U, OF_V, OF_W))
    return (torch.stack([to_u, to_v])[:, :, None] - centre[:, None] * to_w[None, :, None]) / w


def profiles(
    variance: Float[Tensor, "*n"], fourth: Float[Tensor, "*n"]
) -> tuple[Float[Tensor, "*n"], Float[Tensor, "*n e"]]:
    """Half width and coefficients of the profile of a variance and a negated fourth cumulant."""
    power = (3 * variance**2 / fourth - 2.5).clamp(0, len(PIECES))
    n = power.detach().long().clamp_max(len(PIECES) - 1)
    piece, share = torch.from_numpy(PIECES).to(variance.device)[n], power - n
    spread = piece[..., VARIANCE] + share * piece[..., VARIANCE_STEP]
    coefficients = piece[..., COEFFICIENTS:STEPS] + share[..., None] * piece[..., STEPS:]
    return (variance / spread).sqrt(), coefficients
