"""Laws of operators, methods and heads as numbers: the deviation from a law, zero where it holds.

Each function takes the inputs of its caller. The contract checks compare the numbers with their
tolerances; the tests and the stress plan of mvrecon-bench compare them on cases of their own.
"""

from collections.abc import Callable, Iterable

import torch
from torch import Tensor

from mvrecon.geometry.cameras.camera import Cameras
from mvrecon.geometry.grid import Grid
from mvrecon.operators.operator import LinearOperator
from mvrecon.operators.ray_transform import RayTransform
from mvrecon.operators.selection import SKIPS


def gap(result: Tensor, expected: Tensor) -> float:
    """Relative L2 error in float64; the norm itself if zeros are expected; infinite instead of NaN.

    Raises:
        AssertionError: the shapes differ.
    """
    _check_shapes(result, expected)
    a, b = result.detach().double().cpu(), expected.detach().double().cpu()
    norm = float(b.norm())
    return float((a - b).norm().nan_to_num(torch.inf)) / (norm if 0 < norm < torch.inf else 1.0)


def bits(result: Tensor, expected: Tensor) -> float:
    """Number of differing values; NaN equals NaN.

    Raises:
        AssertionError: the shapes differ.
    """
    _check_shapes(result, expected)
    return float((~((result == expected) | (result.isnan() & expected.isnan()))).sum())


def greatest(errors: Iterable[float]) -> float:
    """Maximum that propagates NaN, unlike Python's `max`."""
    return float(torch.tensor(list(errors), dtype=torch.float64).max())


def _check_shapes(result: Tensor, expected: Tensor) -> None:
    if result.shape != expected.shape:
        raise AssertionError(
            f"expected the shape {tuple(expected.shape)}, got {tuple(result.shape)}"
        )


def noise(
    A: LinearOperator,
    dtype: torch.dtype = torch.float64,
    batch: int = 1,
    channels: int = 1,
    seed: int = 0,
) -> tuple[Tensor, Tensor]:
    """A volume and views of normally distributed values for an operator, the same in each dtype."""
    rng = torch.Generator().manual_seed(seed)
    x, y = (
        torch.randn(batch, channels, *shape, generator=rng, dtype=torch.float64)
        for shape in (A.domain_shape, A.range_shape)
    )
    return x.to(dtype), y.to(dtype)


def inner_product_gap(
    x: Tensor, Ax: Tensor, y: Tensor, ATy: Tensor, scale: Tensor | None = None
) -> float:
    """|<A x, y> - <x, A^T y>| / (|A x| |y|), summed in float64: zero for a matched adjoint.

    Args:
        x, y: elements of domain and range.
        Ax, ATy: their images.
        scale: a divisor in place of |A x| |y|, for values of which most cancel.
    """
    x, Ax, y, ATy = (each.detach().double().cpu() for each in (x, Ax, y, ATy))
    apart = ((Ax * y).sum() - (x * ATy).sum()).abs()
    scale = Ax.norm() * y.norm() if scale is None else scale.detach().double().cpu()
    return float((apart / scale).nan_to_num(torch.inf)) if apart != 0 else 0.0


def adjoint_gap(A: LinearOperator, x: Tensor | None = None, y: Tensor | None = None) -> float:
    """`inner_product_gap` of an operator and its adjoint, for noise unless x and y are given."""
    if x is None or y is None:
        x, y = noise(A)
    return inner_product_gap(x, A(x), y, A.T(y))


def linearity_gap(
    A: Callable[[Tensor], Tensor], x: Tensor, y: Tensor, a: float = 2.0, b: float = -1.0
) -> float:
    """Relative error of A(a x + b y) = a A x + b A y."""
    return gap(A(a * x + b * y), a * A(x).double() + b * A(y).double())


def homogeneity_gap(
    f: Callable[..., Tensor], *inputs: Tensor, factors: Iterable[float] = (2.0**-10, 2.0**10)
) -> float:
    """Greatest relative error of f(c y) = c f(y) over some factors, which multiply all inputs."""
    expected = f(*inputs)
    return greatest(gap(f(*(c * each for each in inputs)) / c, expected) for c in factors)


def batch_gap(f: Callable[[Tensor], Tensor], batch: Tensor) -> float:
    """Greatest relative error of the result of a sample alone, against that within its batch."""
    results = f(batch).split(1)
    return greatest(map(gap, map(f, batch.split(1)), results))


def support_gap(A: LinearOperator, support: Tensor, x: Tensor, y: Tensor) -> float:
    """Greatest relative error of A diag(M) and diag(M) A^T for an operator with a support M."""
    masked = A.with_support(support)
    errors = gap(masked(x), A(x * support)), gap(masked.T(y), A.T(y) * support)
    return greatest(errors)


def subset_gap(A: LinearOperator, S: LinearOperator, x: Tensor, y: Tensor) -> float:
    """Greatest relative error of a subset S A against the entries of A x and the adjoint of S A.

    Args:
        A: the whole operator.
        S: the selection of views or rays.
        x: a volume.
        y: views of the whole rig.
    """
    B, chosen = A.subset(S), S(y)
    return greatest([gap(B(x), S(A(x))), gap(B.T(chosen), A.T(S.T(chosen)))])


def skip_gap(A: RayTransform, x: Tensor) -> float:
    """Number of values of A x that any mode of skipping zeros changes."""
    before, A.skip = A.skip, "off"
    try:
        expected, changed = A(x), 0.0
        for A.skip in SKIPS:
            changed += bits(A(x), expected)
    finally:
        A.skip = before
    return changed


def motion_gap(
    build: Callable[[Grid, Cameras], LinearOperator],
    grid: Grid,
    cameras: Cameras,
    x: Tensor,
    R: Tensor,
    t: Tensor,
) -> float:
    """Relative change of the views if volume and cameras undergo one rigid motion."""
    return gap(build(grid.moved(R, t), cameras.moved(R, t))(x), build(grid, cameras)(x))


def gradient_gap(
    f: Callable[..., Tensor], *inputs: Tensor, directions: int = 4, step: float = 1e-5
) -> float:
    """Greatest error of a derivative along random directions against central differences, relative
    to the norms of gradient and direction.

    Args:
        f: a function of float64 tensors, reduced to a number by random weights.
        inputs: its arguments; those that require a gradient are tested one by one.
        directions: number of directions per input.
        step: step of the differences.
    """
    rng, value = torch.Generator().manual_seed(0), f(*inputs)
    weights = torch.randn(value.shape, generator=rng, dtype=torch.float64).to(value)
    tested = [i for i, each in enumerate(inputs) if each.requires_grad]
    slopes = torch.autograd.grad((value * weights).sum(), [inputs[i] for i in tested])
    errors = []
    with torch.no_grad():
        for i, slope in zip(tested, slopes, strict=True):
            for _ in range(directions):
                way = torch.randn(slope.shape, generator=rng, dtype=torch.float64).to(slope)
                more, less = (
                    (f(*inputs[:i], inputs[i] + h * way, *inputs[i + 1 :]) * weights).sum()
                    for h in (step, -step)
                )
                error = ((more - less) / (2 * step) - (slope * way).sum()).abs()
                errors.append(float(error / ((slope.norm() * way.norm()) or 1)))
    return greatest(errors)


def derivative_gap(A: LinearOperator, x: Tensor, y: Tensor) -> float:
    """Greatest relative error of the derivatives of <A x, y> of first and second order in x and y:
    those of first order are A x and A^T y, those of second order the operator and its adjoint.
    """
    x, y = (each.detach().requires_grad_() for each in (x, y))
    by_x, by_y = torch.autograd.grad((A(x) * y).sum(), (x, y), create_graph=True)
    w, z = y.detach().roll(1, -1) + 0.5, x.detach().roll(1, -1) + 0.5
    (mixed,) = torch.autograd.grad((by_y * w).sum(), x, retain_graph=True)
    (other,) = torch.autograd.grad((by_x * z).sum(), y)
    pairs = (by_x, A.T(y)), (by_y, A(x)), (mixed, A.T(w)), (other, A(z))
    return greatest(gap(*pair) for pair in pairs)
