"""Algebra of a projector: the matched adjoint, linearity, rigid motions of volume and cameras."""

from collections.abc import Iterator

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
from mvrecon_bench.stresses.case import DIGITS, EXACT, PRECISE, case
from mvrecon_bench.stresses.subject import GRID, ProjectorSubject


@case("projector", 13, DIGITS)
def moved(subject: ProjectorSubject) -> float:
    """Rig and volume moved together: the same views."""
    rig, volume = subject.rig(), subject.random(1, 1, *GRID.shape)
    rng = torch.Generator().manual_seed(0)
    motions = [
        (random_rotation(rng), 100 * torch.randn(3, generator=rng, dtype=torch.float64))
        for _ in range(5)
    ]
    return greatest(motion_gap(subject.projector, GRID, rig, volume, *one) for one in motions)


@case("projector", 29, PRECISE)
def adjoint(subject: ProjectorSubject) -> Iterator[float]:
    """The adjoint in twenty geometries: <A x, y> = <x, A^T y>, for positive values."""
    subject.need("matched")
    rng = torch.Generator().manual_seed(0)
    for seed in range(20):
        size = torch.randint(2, 9, (3,), generator=rng).tolist()
        spacing = (10 ** (torch.rand(3, generator=rng) - 0.5)).tolist()
        centre = (20 * torch.rand(3, generator=rng, dtype=torch.float64) - 10).tolist()
        pixels = torch.randint(1, 8, (2,), generator=rng).tolist()
        pitch, offset = (0.5 + 3 * torch.rand(2, 2, generator=rng)).tolist()
        R, turn = random_rotation(rng), random_rotation(rng)
        grid = Grid.centred(size=size, spacing=spacing, centre=centre)
        grid = grid.moved(R, grid.centre - R @ grid.centre)
        detector = {"pixels": pixels, "pixel_mm": pitch, "offset_mm": offset}
        rig = subject.rig(grid, detector, n_views=1 + seed % 3)
        A = subject.projector(grid, rig.moved(turn, grid.centre - turn @ grid.centre))
        x = subject.random(1, 2, *grid.shape, seed=seed)
        y = subject.random(1, 2, len(rig), *rig.shape, seed=seed + 100)
        yield adjoint_gap(A, x, y)


@case("projector", 30, EXACT)
def linear(subject: ProjectorSubject) -> float:
    """Linearity, zero: views of sums are sums of views, for multiples by 3, -1e-3 and 1e6."""
    A = subject.projector(GRID, subject.rig())
    x, y = subject.random(2, 1, *GRID.shape)[:, None]
    scales = homogeneity_gap(A, x, factors=(3.0, -1e-3, 1e6))
    zero = float((A(0 * x) != 0).sum()) + float((A.T(0 * A(x)) != 0).sum())
    return greatest([linearity_gap(A, x, y, 1, 1), scales]) + zero
