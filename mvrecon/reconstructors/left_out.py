"""Quality without truth: what all other cameras predict for a camera's view."""

from collections.abc import Callable

import torch
from jaxtyping import Float
from torch import Tensor

from mvrecon.cameras.views import check_finite
from mvrecon.geometry.box import Box
from mvrecon.projectors.operator import LinearOperator, Projector


@torch.no_grad()
def left_out_residual(
    method: Callable[[Projector, Tensor], Tensor],
    A: LinearOperator,
    views: Float[Tensor, "b c m v u"],
) -> Float[Tensor, "b m"]:
    """Relative error of each view as the other cameras predict it, |y_m - A_m x| / |y_m| with x
    from all views but the m-th, without a unit.

    It is large where a camera is wrong, and where the others do not determine what it sees; unlike
    |y - A x| it does not fall with every iteration. The cost is that of M reconstructions
    (leave-one-out: Wahba, Spline Models for Observational Data, 1990, chapter 4).

    Args:
        method: from an operator and its views to a volume, such as `partial(sirt, iterations=20)`.
        A: the operator.
        views: measured.

    Raises:
        ValueError: fewer than two views, or values that are not finite.
    """
    count = A.range_shape[0]
    if count < 2:
        raise ValueError(f"expected at least two views to leave one out, got {count}")
    check_finite(views)
    grid, errors = Box.whole(A.domain_shape), []  # a crop, unlike a subset, knows its voxels' size
    for m in range(count):
        others = [n for n in range(count) if n != m]
        volume = method(A.cropped(grid, others), views[:, :, others])
        view = views[:, :, [m]]
        rest = (view - A.cropped(grid, [m])(volume)).flatten(1).norm(dim=1)
        errors.append(rest / view.flatten(1).norm(dim=1).clamp_min(torch.finfo(view.dtype).tiny))
    return torch.stack(errors, dim=1)
