"""Values: zeros of either sign, NaN, infinity, negative ones."""

import itertools
from collections.abc import Iterator
from typing import Any

import torch

from mvrecon.geometry.grid import Box, Grid
from mvrecon.operators.ray_transform import RayTransform
from mvrecon.operators.selection import SKIPS
from mvrecon.testing.measures import bits, gap
from mvrecon_bench.stresses.analytic import box_lengths
from mvrecon_bench.stresses.case import EVERY, PRECISE, DoesNotApply, case
from mvrecon_bench.stresses.subject import ProjectorSubject

#: More than one brick along each axis, and a detector that sees only some of them.
BRICKS = Grid.centred(size=(10, 17, 9), spacing=(1.0, 1.2, 0.9), centre=(3.0, -2.0, 4.0))
NARROW = {"pixels": [5, 4], "pixel_mm": 0.9, "offset_mm": [0.13, -0.21]}
NO_NUMBERS = (torch.nan, torch.inf)


def skips(A: Any) -> Iterator[None]:
    """Iterate over the operator's modes of skipping zeros."""
    if not isinstance(A, RayTransform):
        yield
        return
    for A.skip in SKIPS:
        yield


@case("projector", 19, 0.0, EVERY)
def zeros(subject: ProjectorSubject) -> Iterator[float]:
    """Volumes and views of zeros of either sign: exactly zero, and gradients are those of the
    adjoint.
    """
    A, one, rays = subject.pair()
    for zero in (0.0, -0.0):
        x = torch.full_like(one, zero).requires_grad_()
        yield float((A.T(torch.full_like(rays, zero)) != 0).sum())
        for _ in skips(A):
            (gradient,) = torch.autograd.grad((views := A(x)).sum(), x)
            expected = A.T(torch.ones_like(views)).to(x.dtype)
            yield float((views != 0).sum()) + (not gap(gradient, expected) <= 1e-5)


@case("projector", 47, 0.0, EVERY)
def bad_voxels(subject: ProjectorSubject) -> Iterator[float]:
    """A voxel that is no number: exactly the rays that meet it are none, whether many, few or no
    rays do, among finite values or zeros.
    """
    subject.need("local")
    A, x, y = subject.pair(BRICKS, detector=NARROW)
    met = A.T(torch.ones_like(y)).flatten()
    for voxel in (met.argmax(), torch.where(met > 0, met, torch.inf).argmin(), met.argmin()):
        chosen = torch.zeros_like(x).flatten().index_fill(0, voxel, 1).view_as(x)
        hits = A(chosen) != 0
        told = f"the adjoint reports {met[voxel]} at voxel {int(voxel)}, the views do not"
        assert bool(hits.any()) == bool(met[voxel] > 0), told
        for bad, background in itertools.product(NO_NUMBERS, (x, torch.zeros_like(x))):
            spoilt = torch.where(chosen > 0, bad, background)
            yield sum(float((A(spoilt).isfinite() == hits).sum()) for _ in skips(A))
    yield 0.0 if float(met.min()) == 0 else torch.nan


@case("projector", 47)
def bad_pixel(subject: ProjectorSubject) -> Iterator[float]:
    """A pixel that is no number: exactly the voxels on its ray are none."""
    subject.need("local")
    A, _, y = subject.pair(BRICKS)
    one = torch.zeros_like(y)
    one[..., 1, 2, 3] = 1
    met = A.T(one) != 0
    for bad, background in itertools.product(NO_NUMBERS, (y, torch.zeros_like(y))):
        spoilt = A.T(torch.where(one > 0, bad, background))
        yield float((spoilt.isfinite() == met).sum())
    yield 0.0 if met.any() else torch.nan


@case("projector", 47, 0.0, EVERY)
def beyond_support(subject: ProjectorSubject) -> float:
    """No numbers outside of a support: not met."""
    A, x, _ = subject.pair(BRICKS)
    if not isinstance(A, RayTransform):
        raise DoesNotApply("it has no supports")
    inside = torch.zeros(BRICKS.shape, dtype=torch.bool)
    inside[2:7, 3:12, 1:8] = True
    inside[4:6, 5:9, 3:5] = False
    mask, masked = inside.to(x.device), A.with_support(inside)
    return sum(bits(masked(torch.where(mask, x, bad)), A(x * mask)) for bad in NO_NUMBERS)


@case("projector", 47)
def touched(subject: ProjectorSubject) -> float:
    """No number at a corner, edge or face: rays with a length in it are none, others not; where a
    ray only touches the voxel's support, with a weight of zero, either is valid (0 * NaN).
    """
    subject.need_exact()
    grid = Grid.centred((4, 4, 4), 1.0)
    ways = [[1.0, 1, 0], [1, -1, 0], [0, 1, 1], [2, 1, 0], [1, 1, 1]]
    middles = [[0, 0, 0.3], [0, 0, 0.3], [0.3, 0, 0], [0, 0, 0.3], [0, 0, 0]]
    way, middle = torch.tensor([ways, middles], dtype=torch.float64)
    rig = subject.rays(middle - 20 * way, middle + 20 * way)
    A = subject.projector(grid, rig)
    voxels = torch.eye(64, dtype=subject.dtype, device=subject.device).reshape(64, 1, 4, 4, 4)
    alone = subject.random(1, 1, 4, 4, 4).expand(64, -1, -1, -1, -1)
    spoilt = ~A(torch.where(voxels > 0, torch.nan, alone)).isfinite().flatten(1).cpu()
    weighed = (A(voxels) != 0).flatten(1).cpu()
    reach = 1e-9 + (0.0 if subject.of_cells else 0.5)
    corners = itertools.product(range(4), repeat=3)
    boxes = [Box((z, y, x), (z + 1, y + 1, x + 1)) for z, y, x in corners]
    near = torch.stack([box_lengths(rig, grid.cropped(box), reach).flatten() > 0 for box in boxes])
    return float(((weighed & ~spoilt) | (spoilt & ~near)).sum())


@case("projector", 49, PRECISE, EVERY)
def negative(subject: ProjectorSubject) -> float:
    """Negative values: mirrored to the bit, and linear for mixed signs."""
    A, x, y = subject.pair(BRICKS)
    views = A(x)
    mirrored = bits(A.T(-y), -A.T(y)) + sum(bits(A(-x), -views) for _ in skips(A))
    mixed = x.clone()
    mixed[..., 4:12, 2:9] -= 2
    return mirrored + gap(A(mixed), A(mixed.clamp_min(0)) - A((-mixed).clamp_min(0)))
