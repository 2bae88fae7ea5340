"""Accuracy of a projector: adjointness, values that are not finite, repeatability, and its gradient
by the pose.
"""

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from mvrecon.geometry.cameras.camera import Cameras
from mvrecon.geometry.grid import Grid
from mvrecon_bench.benchmarks.truth import arm_of


def adjointness(x: Tensor, views: Tensor, y: Tensor, volume: Tensor) -> float:
    """|<A x, y> - <x, A^T y>| / (|A x| |y|), summed in float64."""
    x, views, y, volume = (t.double() for t in (x, views, y, volume))
    return (((views * y).sum() - (x * volume).sum()).abs() / (views.norm() * y.norm())).item()


def not_finite(tensors: Sequence[Tensor]) -> int:
    """How many values are NaN or infinite."""
    return sum(int((~t.isfinite()).sum()) for t in tensors)


def same_bits(a: Tensor, b: Tensor) -> bool:
    """Whether two results are the same to the last bit, NaN included."""
    return torch.equal(a.contiguous().view(torch.uint8), b.contiguous().view(torch.uint8))


def rigid(
    gradients: Sequence[Float[Tensor, "m 3"]], cameras: Cameras, grid: Grid
) -> Float[Tensor, "m 6"]:
    """Derivatives by turns and shifts of each camera, as `truth.pose_gradient`, from those by its
    four vectors.
    """
    source, origin, u, v = (g.detach().double().cpu() for g in gradients)
    pairs = (
        (cameras.source - grid.centre, source),
        (cameras.origin - grid.centre, origin),
        (cameras.u, u),
        (cameras.v, v),
    )
    turn = sum((torch.linalg.cross(arm, g) for arm, g in pairs), start=torch.zeros_like(source))
    return torch.cat([turn / arm_of(grid), source + origin], dim=1)


def cosine(a: Tensor, b: Tensor) -> float:
    """Of the angle between two gradients: 1 where they point the same way."""
    return torch.nn.functional.cosine_similarity(a.flatten(), b.flatten(), dim=0).item()
