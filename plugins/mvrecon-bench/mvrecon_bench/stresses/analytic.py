"""Closed-form views: sums over rows of voxels, chords of a box, integrals of a Gaussian blob."""

import itertools
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from mvrecon.data.scenes.solids import Phantom, Solids
from mvrecon.geometry.cameras.camera import Cameras
from mvrecon.geometry.grid import Grid, voxel_centres

#: Integer directions, used in all permutations and signs.
DIRECTIONS = ((1, 1, 1), (1, 1, 0), (2, 1, 0), (2, 1, 1), (3, 2, 1), (3, 1, 0))
#: Start and end points of rays in world mm, and their expected integrals.
Seen = tuple[Float[Tensor, "r 3"], Float[Tensor, "r 3"], Float[Tensor, " r"]]


def rows(grid: Grid, volume: Float[Tensor, "d h w"]) -> Seen:
    """Rays through voxel centres along x, y and z, with both ends outside the grid: sums times the
    spacing.
    """
    bundles = []
    for axis in range(3):
        counts = [grid.shape[2 - i] for i in range(3) if i != axis]
        index = torch.cartesian_prod(*[torch.arange(n, dtype=torch.float64) for n in counts])
        sums = volume.double().cpu().sum(dim=2 - axis).mT.flatten() * grid.spacing[axis]
        bundles.append((*ends(grid, axis, index), sums))
    start, end, sums = (torch.cat(points) for points in zip(*bundles, strict=True))
    return start, end, sums


def ends(
    grid: Grid, axis: int, index: Float[Tensor, "r 2"]
) -> tuple[Float[Tensor, "r 3"], Float[Tensor, "r 3"]]:
    """Start and end points, outside the grid, of rays along an axis at voxel indices of the other
    two axes.
    """
    start = torch.zeros(len(index), 3, dtype=torch.float64)
    start[:, [i for i in range(3) if i != axis]] = index
    end = start.clone()
    start[:, axis], end[:, axis] = -20.0, grid.shape[2 - axis] + 25.0
    return grid.to_world(start), grid.to_world(end)


def through(grid: Grid) -> Seen:
    """Oblique rays between opposite faces along x, y and z, and their lengths in the box.

    They keep half a voxel distance from the other faces, and are central along axes of one voxel,
    so that interpolating projectors return the same for ones.
    """
    rng = torch.Generator().manual_seed(0)
    sizes = torch.tensor(grid.shape[::-1], dtype=torch.float64)
    bundles = []
    for axis in range(3):
        enter, leave = (
            (sizes - 1) * torch.rand(12, 3, generator=rng, dtype=torch.float64) for _ in range(2)
        )
        way = leave - enter
        enter[:, axis], way[:, axis] = -0.5, 0
        steep = way.abs().amax(dim=-1, keepdim=True) / (0.9 * sizes[axis])
        way /= steep.clamp(min=1)  # the main axis of a ray is the fastest one, in voxels
        way[:, axis] = sizes[axis]
        bundles.append((grid.to_world(enter - 2 * way), grid.to_world(enter + 3.5 * way)))
    start, end = (torch.cat(points) for points in zip(*bundles, strict=True))
    return start, end, (end - start).norm(dim=-1) / 5.5


def ways() -> Float[Tensor, "r 3"]:
    """All permutations and signs of the integer directions: lines along them through lattice points
    meet edges and corners.
    """
    orders, signs = itertools.permutations(range(3)), itertools.product((-1, 1), repeat=3)
    signed = itertools.product(DIRECTIONS, list(orders), list(signs))
    found = {
        tuple(way[i] * s for i, s in zip(order, sign, strict=True)) for way, order, sign in signed
    }
    return torch.tensor(sorted(found), dtype=torch.float64)


def box_lengths(rig: Cameras, grid: Grid, grown: float = 0.0) -> Float[Tensor, "m v u"]:
    """Length in mm of each ray inside the box of an axis-aligned grid, extended by some voxels on
    every side.
    """
    sizes = zip(grid.shape[::-1], grid.spacing, strict=True)
    half = torch.tensor([[(n / 2 + grown) * mm for n, mm in sizes]], dtype=torch.float64)
    return Phantom((Solids.upright("box", grid.centre[None], half, torch.ones(1)),)).views(rig)


@dataclass(frozen=True, eq=False)
class Blob:
    """The smooth blob exp(-|X - centre|^2 / 2 sigma^2); sigma and centre in mm."""

    centre: Float[Tensor, "3"]
    sigma: float

    def values(self, grid: Grid) -> Float[Tensor, "d h w"]:
        """Values at voxel centres."""
        return self._bell(voxel_centres(grid) - self.centre)

    def integrals(
        self, start: Float[Tensor, "*r 3"], end: Float[Tensor, "*r 3"]
    ) -> Float[Tensor, "*r"]:
        """Integrals along the infinite lines through these points, in mm."""
        along = torch.nn.functional.normalize(end - start, dim=-1)
        off = torch.linalg.cross(start - self.centre, along)
        return self.sigma * (2 * torch.pi) ** 0.5 * self._bell(off)

    def _bell(self, off: Tensor) -> Tensor:
        return torch.exp(-off.square().sum(dim=-1) / (2 * self.sigma**2))
