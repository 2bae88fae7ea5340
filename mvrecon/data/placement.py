"""Where a file's volume lies in the world of a case: centred, or varied at random."""

from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from mvrecon.data.slabs import Slabs
from mvrecon.geometry.grid import Grid
from mvrecon.geometry.rigid import euler_rotation
from mvrecon.scenes.analytic import uniform

#: How far a varied copy departs from its case: degrees about each axis, part of the size, mm along
#: each axis.
TURN, SCALE, SHIFT = 10.0, 0.1, 20.0


class Placed(NamedTuple):
    """A case of a file: its attenuation, where its voxels lie in the file's world and in the
    case's, in mm, and whether it is mirrored left to right.
    """

    name: str
    mu: Slabs
    source: Grid
    grid: Grid
    mirrored: bool = False


def moved(
    grid: Grid,
    pivot: Float[Tensor, "3"],
    target: Float[Tensor, "3"],
    rng: torch.Generator | None,
    exact: bool = False,
) -> Grid:
    """A grid carried from one point to another, with `rng` also turned, scaled and shifted about it
    at random; an exact move shifts alone, so that axes stay parallel.
    """
    linear = torch.eye(3, dtype=torch.float64)
    if rng is not None and not exact:
        angles = [uniform(rng, -TURN, TURN) for _ in range(3)]
        linear = uniform(rng, 1 - SCALE, 1 + SCALE) * euler_rotation(angles, "xyz")
    if rng is not None:
        target = target + torch.tensor(
            [uniform(rng, -SHIFT, SHIFT) for _ in range(3)], dtype=torch.float64
        )
    affine = grid.affine.clone()
    affine[:3, :3] = linear @ affine[:3, :3]
    affine[:3, 3] = linear @ (affine[:3, 3] - pivot) + target
    return Grid(grid.shape, affine)
