"""Derivatives of a projector: central differences, kinks, second order, forward mode, vmap and
compiled graphs.
"""

from collections.abc import Iterator
from typing import Any

import torch
from torch import Tensor
from torch.func import jacrev, jvp, vmap

from mvrecon.geometry.grid import Grid
from mvrecon.testing.measures import derivative_gap, gap, gradient_gap, greatest
from mvrecon_bench.stresses.analytic import ends, ways
from mvrecon_bench.stresses.case import DIGITS, DOUBLE, EXACT, SINGLE, DoesNotApply, case
from mvrecon_bench.stresses.subject import ProjectorSubject

#: Few rays, in a pose without rays on a kink.
FEW = {"pixels": [3, 2], "pixel_mm": [2.1, 2.3], "offset_mm": [0.4, -0.3]}
SMALL = Grid.centred(size=(3, 4, 3), spacing=(1.0, 1.2, 0.9), centre=(3.0, -2.0, 4.0))


def small(subject: ProjectorSubject) -> tuple[Any, Tensor, Tensor]:
    """An operator with a volume and views."""
    return subject.pair(SMALL, detector=FEW, n_views=2)


@case("projector", 33, 1e-6, DOUBLE)
def differences(subject: ProjectorSubject) -> float:
    """Derivatives by volume and pose: finite differences."""
    views, vectors = subject.posed(SMALL, subject.rig(SMALL, FEW, n_views=2))
    return gradient_gap(views, subject.random(1, 1, *SMALL.shape).requires_grad_(), *vectors)


@case("projector", 34)
def kinks(subject: ProjectorSubject) -> float:
    """Derivatives where rays cross edges of voxels: finite."""
    grid = Grid.centred((4, 4, 4), 1.0)
    halves = torch.cartesian_prod(*[torch.arange(-2, 10).double() / 2] * 2)
    rays = [ends(grid, axis, halves) for axis in range(3)] + [(-9 * ways(), 10 * ways())]
    if subject.beam[1] == "segment":
        rays.append((0 * ways(), 1e-12 * ways()))
    start, end = (torch.cat(points) for points in zip(*rays, strict=True))
    views, vectors = subject.posed(grid, subject.rays(start, end))
    volume = subject.random(1, 1, 4, 4, 4).requires_grad_()
    slopes = torch.autograd.grad(views(volume, *vectors).sum(), [volume, *vectors])
    return float(sum((~slope.isfinite()).sum() for slope in slopes))


@case("projector", 35, DIGITS)
def twice(subject: ProjectorSubject) -> float:
    """Second derivatives in volume and views: the operator itself."""
    return derivative_gap(*small(subject))


@case("projector", 35, 1e-5, DOUBLE)
def twice_by_pose(subject: ProjectorSubject) -> float:
    """Second derivatives in the pose: finite differences, or an error."""
    views, (source, *others) = subject.posed(SMALL, subject.rig(SMALL, FEW, n_views=2))
    volume, way = subject.random(1, 1, *SMALL.shape), torch.randn(source.shape, dtype=torch.float64)

    def slope(at: Tensor, graph: bool = False) -> Tensor:
        total = views(volume, at, *others).square().sum()
        return (torch.autograd.grad(total, at, create_graph=graph)[0] * way).sum()

    try:
        (second,) = torch.autograd.grad(slope(source, True), source)
    except NotImplementedError as error:
        if not str(error):
            raise
        return 0.0
    more, less = (slope((source + step * way).detach().requires_grad_()) for step in (1e-5, -1e-5))
    return float(((second * way).sum() - (more - less) / 2e-5).abs() / (second.norm() * way.norm()))


@case("projector", 36, EXACT)
def mapped(subject: ProjectorSubject) -> Iterator[float]:
    """vmap: equal to a loop, over volumes and views, also nested."""
    A = small(subject)[0]
    x, y = subject.random(3, 2, 1, 1, *SMALL.shape), subject.random(3, 2, 1, 1, 2, 3, 2)
    for act, operands in ((A, x), (A.T, y)):
        loop = torch.stack([torch.stack([act(one) for one in row]) for row in operands])
        second = vmap(act, in_dims=1)(operands[0].transpose(0, 1))
        yield gap(vmap(act)(operands[:, 0]), loop[:, 0])
        yield gap(second, loop[0])
        yield gap(vmap(vmap(act))(operands), loop)


@case("projector", 36, EXACT)
def jacobians(subject: ProjectorSubject) -> float:
    """jacrev and a vectorised Jacobian: views of single voxels."""
    A, x, _ = small(subject)
    voxels = torch.eye(x.numel()).to(x).reshape(-1, *x.shape)
    columns = torch.stack([A(one) for one in voxels], dim=-1)
    rows = torch.autograd.functional.jacobian(A, x, vectorize=True)
    try:
        found: tuple[Any, Any] = rows, jacrev(A)(x)
    except RuntimeError as error:
        if "functorch" not in str(error):
            raise
        raise DoesNotApply("torch.func finds no derivative of it; torch.autograd does") from error
    return greatest(gap(one.flatten(-x.ndim), columns) for one in found)


@case("projector", 36, EXACT)
def pushed(subject: ProjectorSubject) -> float:
    """Forward-mode derivatives: the operator applied to the tangent."""
    A, x, y = small(subject)
    pairs = [(A, x), (A.T, y)]
    return greatest(
        gap(jvp(act, (at,), (at.roll(1, -1),))[1], act(at.roll(1, -1))) for act, at in pairs
    )


@case("projector", 37, DIGITS, SINGLE)
def compiled(subject: ProjectorSubject) -> Iterator[float]:
    """torch.compile, two sizes: equal to eager mode, in values and gradients."""
    A, x, _ = small(subject)
    x.requires_grad_()

    def step(x: Tensor) -> Tensor:
        return A.T((A(x.sin()) - 1).tanh())

    torch.compiler.reset()
    whole = torch.compile(step, fullgraph=True, backend="aot_eager")
    for volume in (x, torch.cat([x, 2 * x])):  # the second size makes the graph dynamic
        both = whole(volume), step(volume)
        slopes = [torch.autograd.grad(out.square().sum(), volume)[0] for out in both]
        yield gap(*both)
        yield gap(*slopes)
