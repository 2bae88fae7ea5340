"""Algebra of a projector: the matched adjoint, linearity, rigid motions of volume and cameras."""

import torch

from mvrecon.geometry.grid import Grid
from mvrecon.geometry.rigid import random_rotation
from mvrecon.testing.measures import (
    adjoint_gap,
    greatest,
    homogeneity_gap,
    linearity_gap,
    motion_gap,
)
from mvrecon_bench.stresses.case import PRECISE, Case
from mvrecon_bench.stresses.subject import GRID, ProjectorSubject

#: Relative: sums of rounded terms.
LINEAR = {torch.float64: 1e-13, torch.float32: 1e-6}
DIGITS = {torch.float64: 1e-12, torch.float32: 2e-6}


def adjoint(subject: ProjectorSubject) -> float:
    """The adjoint identity in twenty random geometries, for positive values (no cancelling)."""
    subject.need("matched")
    rng, worst = torch.Generator().manual_seed(0), 0.0
    for seed in range(20):
        shape = torch.randint(2, 9, (3,), generator=rng).tolist()
        spacing = 10 ** (torch.rand(3, generator=rng) - 0.5)
        centre = 20 * torch.rand(3, generator=rng, dtype=torch.float64) - 10
        pixels = torch.randint(1, 8, (2,), generator=rng).tolist()
        pitch, offset = (0.5 + 3 * torch.rand(2, 2, generator=rng)).tolist()
        grid = _turned(
            Grid.centred(size=shape[::-1], spacing=spacing.tolist(), centre=centre.tolist()), rng
        )
        rig = subject.rig(
            grid, {"pixels": pixels, "pixel_mm": pitch, "offset_mm": offset}, n_views=1 + seed % 3
        )
        R = random_rotation(rng)
        A = subject.projector(grid, rig.moved(R, grid.centre - R @ grid.centre))
        x = subject.random(1, 2, *grid.shape, seed=seed)
        y = subject.random(1, 2, len(rig), *rig.shape, seed=seed + 100)
        worst = greatest([worst, adjoint_gap(A, x, y)])
    return worst


def linear(subject: ProjectorSubject) -> float:
    """Linearity: sums, multiples by 3, -1e-3 and 1e6, and exactly zero views of a zero volume."""
    A = subject.projector(GRID, subject.rig())
    x, y = subject.random(2, 1, *GRID.shape)[:, None]
    worst = greatest(
        [linearity_gap(A, x, y, 1, 1), homogeneity_gap(A, x, factors=(3.0, -1e-3, 1e6))]
    )
    return worst + float((A(0 * x) != 0).sum()) + float((A.T(0 * A(x)) != 0).sum())


def moved(subject: ProjectorSubject) -> float:
    """Five rigid motions of volume and cameras together leave the views unchanged."""
    rig, volume = subject.rig(), subject.random(1, 1, *GRID.shape)
    rng, errors = torch.Generator().manual_seed(0), []
    for _ in range(5):
        R, t = random_rotation(rng), 100 * torch.randn(3, generator=rng, dtype=torch.float64)
        errors.append(motion_gap(subject.projector, GRID, rig, volume, R, t))
    return greatest(errors)


def _turned(grid: Grid, rng: torch.Generator) -> Grid:
    """The same voxels about the same centre, in a random orientation."""
    R = random_rotation(rng)
    return grid.moved(R, grid.centre - R @ grid.centre)


CASES = (
    Case(13, "rig and volume moved together", "the same views", "projector", moved, DIGITS),
    Case(
        29,
        "the adjoint in twenty geometries",
        "<A x, y> = <x, A^T y>",
        "projector",
        adjoint,
        PRECISE,
    ),
    Case(30, "linearity, zero", "views of sums are sums of views", "projector", linear, LINEAR),
)
