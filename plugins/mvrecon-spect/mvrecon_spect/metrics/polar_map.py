"""The polar map of the left ventricle, and its 17 segments.

Convention: viewed from the apex, the anterior wall is on top and the septum on the left. Angles
increase counter-clockwise from anterior towards the septum, for right-handed world axes. The
ventricle is sampled as a cylinder over two thirds of its length (basal and mid rings) and a cap
over the rest (Germano et al., J. Nucl. Med. 36 (1995) 2107); the segments are defined by Cerqueira
et al., Circulation 105 (2002) 539.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from mvrecon.geometry.grid import Grid
from mvrecon.geometry.lattice import normalised, sample

#: Fraction of the long axis, from the base, along which rays are perpendicular to it.
CYLINDER = 2 / 3
#: The elevation in degrees at which the apical ring ends and the apex begins.
APEX = 60.0
#: Segments of the rings from base to apex.
SEGMENTS = (6, 6, 4, 1)


class LongAxis(NamedTuple):
    """Position of a left ventricle.

    Args:
        base: end point of the axis in the valve plane, (x, y, z) in mm.
        apex: end point of the axis at the tip of the myocardium, (x, y, z) in mm.
        septum: direction (x, y, z) from the axis to the centre of the septum.
    """

    base: Sequence[float]
    apex: Sequence[float]
    septum: Sequence[float]


def polar_map(
    volume: Float[Tensor, "d h w"],
    grid: Grid,
    axis: LongAxis,
    reach_mm: float,
    rows: int = 4,
    angles: int = 72,
) -> Float[Tensor, "4r a"]:
    """Polar map of a ventricle: the maximum along each ray outward from its axis, in the unit of
    the volume.

    Rows run from base to apex, with the same number for the basal, mid and apical rings and the
    apex; columns run from the centre of the anterior wall towards the septum.

    Args:
        volume: activity.
        grid: grid of the volume.
        axis: long axis of the ventricle.
        reach_mm: length of the rays from the axis, beyond the wall but short of other organs.
        rows: number of rows per ring.
        angles: number of angles over the circle; a multiple of 12, so that all segments have the
            same number.

    Raises:
        ValueError: a volume whose shape is not that of the grid, an axis of zero length or parallel
            to the septum direction or with an end outside the grid, a reach that is not positive
            and finite, no rows, or angles that are not a multiple of 12.
    """
    if tuple(volume.shape) != grid.shape:
        raise ValueError(f"Expected a volume of shape {grid.shape}, got {tuple(volume.shape)}")
    if not 0 < reach_mm < math.inf or rows < 1 or angles < 12 or angles % 12:
        raise ValueError(
            f"Expected a positive reach, a row or more and a multiple of 12 angles, got "
            f"{reach_mm}, {rows} and {angles}"
        )
    ends = grid.to_index(torch.tensor([[*axis.base], [*axis.apex]], dtype=torch.float64))
    if not ((ends > -0.5) & (ends < ends.new_tensor(grid.size) - 0.5)).all():
        raise ValueError(
            f"Expected base and apex in the grid, in world mm, got {list(axis.base)} and "
            f"{list(axis.apex)}"
        )
    origins, directions = _rays(axis, rows, angles)
    count = 1 + math.ceil(reach_mm / (min(grid.spacing) / 2) - 1e-6)
    depth = torch.linspace(0, reach_mm, count, dtype=torch.float64)
    points = origins[..., None, :] + directions[..., None, :] * depth[:, None]
    index = normalised(grid.to_index(points), grid.shape)
    return sample(volume.double()[None, None], index[None])[0, 0].amax(dim=-1)


def segments(values: Float[Tensor, "4r a"]) -> Float[Tensor, "17"]:
    """Means of the 17 segments of a polar map, in its unit: basal 1 to 6 from anterior via the
    septum, mid 7 to 12, apical 13 to 16, apex 17.

    In the apex, elevations are weighted by their solid angle, i.e. by the cosine.

    Args:
        values: output of `polar_map`.

    Raises:
        ValueError: the number of rows is not a multiple of 4, or of angles not a multiple of 12.
    """
    rows, angles = values.shape
    if rows % 4 or angles % 12 or not values.numel():
        raise ValueError(
            f"Expected a map of a multiple of 4 rows and of 12 angles, got {rows} and {angles}"
        )
    means = []
    elevation = torch.deg2rad(_elevations(rows // 4)[rows // 4 :])
    for ring, count in zip(values.chunk(4), SEGMENTS, strict=True):
        if count == 1:
            share = elevation.cos().to(values)
            means.append((ring.mean(dim=1) * share).sum()[None] / share.sum())
            continue
        width = angles // count
        # the first segment is centred on the first column: of an even width, half a column each way
        rolls = torch.stack([ring.roll(shift // 2, dims=1) for shift in (width, width - 1)])
        means.append(rolls.unflatten(2, (count, width)).mean(dim=(0, 1, 3)))
    return torch.cat(means)


def _elevations(rows: int) -> Float[Tensor, " 2r"]:
    """Elevation of the apical rows and of the apex rows above the plane perpendicular to the axis,
    in degrees.
    """
    middle = (torch.arange(rows, dtype=torch.float64) + 0.5) / rows
    return torch.cat([APEX * middle, APEX + (90 - APEX) * middle])


def _rays(
    axis: LongAxis, rows: int, angles: int
) -> tuple[Float[Tensor, "4r a 3"], Float[Tensor, "4r a 3"]]:
    """Start points of the rays in mm, and their directions."""
    base, apex, septum = (torch.tensor(list(v), dtype=torch.float64) for v in axis)
    along = apex - base
    length = along.norm()
    tip = along / torch.where(length > 0, length, 1)
    across = septum - (septum @ tip) * tip
    if not length > 0 or not across.norm() > 1e-6 * septum.norm():
        raise ValueError(
            f"Expected an axis with a length and a septum beside it, got base {list(axis.base)}, "
            f"apex {list(axis.apex)} and septum {list(axis.septum)}"
        )
    across = across / across.norm()
    front = torch.linalg.cross(across, tip)
    turn = 2 * math.pi * torch.arange(angles, dtype=torch.float64) / angles
    outward = turn.cos()[:, None] * front + turn.sin()[:, None] * across
    steps = (torch.arange(2 * rows, dtype=torch.float64) + 0.5) / (2 * rows)
    shares = torch.cat([CYLINDER * steps, torch.full((2 * rows,), CYLINDER).double()])
    tilt = torch.deg2rad(torch.cat([torch.zeros(2 * rows).double(), _elevations(rows)]))
    tilt = tilt[:, None, None]
    origins = (base + shares[:, None] * along)[:, None].expand(-1, angles, -1)
    return origins, tilt.cos() * outward + tilt.sin() * tip
