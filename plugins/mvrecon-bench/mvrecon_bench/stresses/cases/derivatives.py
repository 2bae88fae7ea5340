"""Derivatives of a projector: central differences, kinks, second order, forward mode, vmap and
compiled graphs.
"""

from collections.abc import Callable
from functools import partial

import torch
from torch import Tensor

from mvrecon.geometry.grid import Grid
from mvrecon.testing.measures import derivative_gap, gap, gradient_gap, greatest
from mvrecon_bench.stresses.analytic import ends, ways
from mvrecon_bench.stresses.case import Case, DoesNotApply
from mvrecon_bench.stresses.cases.algebra import DIGITS, LINEAR
from mvrecon_bench.stresses.subject import ProjectorSubject

DOUBLE = (torch.float64,)
#: Few rays, in a pose without rays on a kink.
FEW = {"pixels": [3, 2], "pixel_mm": [2.1, 2.3], "offset_mm": [0.4, -0.3]}
SMALL = Grid.centred(size=(3, 4, 3), spacing=(1.0, 1.2, 0.9), centre=(3.0, -2.0, 4.0))


def differences(subject: ProjectorSubject) -> float:
    """Derivatives with respect to the volume and every camera vector, compared with central
    differences along four directions.
    """
    views, vectors = subject.posed(SMALL, subject.rig(SMALL, FEW, n_views=2))
    inputs = [subject.random(1, 1, *SMALL.shape).requires_grad_(), *vectors]
    return gradient_gap(views, *inputs)


def kinks(subject: ProjectorSubject) -> float:
    """Number of non-finite pose derivatives for rays along axes, on faces and edges, through
    corners, and outside the volume.
    """
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


def twice(subject: ProjectorSubject) -> float:
    """First and second derivatives in volume and views: the operator and its adjoint."""
    rig = subject.rig(SMALL, FEW, n_views=2)
    A = subject.projector(SMALL, rig)
    return derivative_gap(A, subject.random(1, 1, *SMALL.shape), subject.random(1, 1, 2, 3, 2))


def twice_by_pose(subject: ProjectorSubject) -> float:
    """A second derivative with respect to the source, compared with differences of the first,
    unless it raises NotImplementedError.
    """
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


def mapped(subject: ProjectorSubject) -> float:
    """vmap over volumes and over views, also nested: the same results as a loop."""
    A = subject.projector(SMALL, subject.rig(SMALL, FEW, n_views=2))
    x, y = subject.random(3, 2, 1, 1, *SMALL.shape), subject.random(3, 2, 1, 1, 2, 3, 2)
    worst = 0.0
    for act, operands in ((A, x), (A.T, y)):
        loop = torch.stack([torch.stack([act(one) for one in row]) for row in operands])
        worst = greatest([worst, gap(torch.func.vmap(act)(operands[:, 0]), loop[:, 0])])
        worst = greatest(
            [worst, gap(torch.func.vmap(act, in_dims=1)(operands[0].transpose(0, 1)), loop[0])]
        )
        worst = greatest([worst, gap(torch.func.vmap(torch.func.vmap(act))(operands), loop)])
    return worst


def jacobian(subject: ProjectorSubject, act: Callable[..., Tensor]) -> float:
    """The Jacobian, vectorised over rows or columns: views of individual voxels."""
    A, x = (
        subject.projector(SMALL, subject.rig(SMALL, FEW, n_views=2)),
        subject.random(1, 1, *SMALL.shape),
    )
    columns = torch.stack(
        [A(one) for one in torch.eye(x.numel()).to(x).reshape(-1, *x.shape)], dim=-1
    )
    try:
        return gap(act(A, x).flatten(-x.ndim), columns)
    except RuntimeError as error:
        if "functorch" not in str(error):
            raise
        raise DoesNotApply("torch.func finds no derivative of it; torch.autograd does") from error


def pushed(subject: ProjectorSubject) -> float:
    """Forward-mode derivatives with respect to volume and views: the operator or its adjoint,
    applied to the tangent.
    """
    A, worst = subject.projector(SMALL, subject.rig(SMALL, FEW, n_views=2)), 0.0
    for act, shape in ((A, (1, 1, *SMALL.shape)), (A.T, (1, 1, 2, 3, 2))):
        operand, tangent = subject.random(*shape), subject.random(*shape, seed=1)
        worst = greatest([worst, gap(torch.func.jvp(act, (operand,), (tangent,))[1], act(tangent))])
    return worst


def compiled(subject: ProjectorSubject) -> float:
    """Operator, adjoint and pointwise functions in one compiled graph, for two sizes: the same
    values and gradients.
    """
    A = subject.projector(SMALL, subject.rig(SMALL, FEW, n_views=2))
    x = subject.random(1, 1, *SMALL.shape).requires_grad_()

    def step(x: Tensor) -> Tensor:
        return A.T((A(x.sin()) - 1).tanh())

    torch.compiler.reset()
    whole, worst = torch.compile(step, fullgraph=True, backend="aot_eager"), 0.0
    for volume in (x, torch.cat([x, 2 * x])):  # the second size makes the graph dynamic
        result, expected = whole(volume), step(volume)
        slopes = [
            torch.autograd.grad(output.square().sum(), volume)[0] for output in (result, expected)
        ]
        worst = greatest([worst, gap(result, expected), gap(*slopes)])
    return worst


def _jacrev(A: Callable[..., Tensor], x: Tensor) -> Tensor:
    return torch.func.jacrev(A)(x)  # type: ignore[return-value]


def _rows(A: Callable[..., Tensor], x: Tensor) -> Tensor:
    return torch.autograd.functional.jacobian(A, x, vectorize=True)  # type: ignore[return-value]


CASES = (
    Case(
        33,
        "derivatives by volume and pose",
        "finite differences",
        "projector",
        differences,
        1e-6,
        DOUBLE,
    ),
    Case(34, "derivatives where rays cross edges of voxels", "finite", "projector", kinks),
    Case(
        35,
        "second derivatives in volume and views",
        "the operator itself",
        "projector",
        twice,
        DIGITS,
    ),
    Case(
        35,
        "second derivatives in the pose",
        "finite differences, or an error",
        "projector",
        twice_by_pose,
        1e-5,
        DOUBLE,
    ),
    Case(36, "vmap", "equal to a loop", "projector", mapped, LINEAR),
    Case(
        36, "jacrev", "views of single voxels", "projector", partial(jacobian, act=_jacrev), LINEAR
    ),
    Case(
        36,
        "a vectorised Jacobian",
        "views of single voxels",
        "projector",
        partial(jacobian, act=_rows),
        LINEAR,
    ),
    Case(
        36,
        "forward-mode derivatives",
        "the operator applied to the tangent",
        "projector",
        pushed,
        LINEAR,
    ),
    Case(
        37,
        "torch.compile, two sizes",
        "equal to eager mode",
        "projector",
        compiled,
        DIGITS,
        (torch.float32,),
    ),
)
