"""Accuracy of a projector: non-finite values, repeatability, and pose gradient."""

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from mvrecon.geometry.cameras.camera import Cameras
from mvrecon.geometry.grid import Grid
from mvrecon_bench.benchmarks.truth import arm_of


def not_finite(tensors: Sequence[Tensor]) -> int:
    """Number of NaN or infinite values."""
    return sum(int((~t.isfinite()).sum()) for t in tensors)


def same_bits(a: Tensor, b: Tensor) -> bool:
    """Whether two results are bitwise identical, including NaN."""
    return torch.equal(a.contiguous().view(torch.uint8), b.contiguous().view(torch.uint8))


def rigid(
    gradients: Sequence[Float[Tensor, "m 3"]], cameras: Cameras, grid: Grid
) -> Float[Tensor, "m 6"]:
    """Convert derivatives with respect to a camera's four vectors to those with respect to its
    rotations and translations, as in `truth.pose_gradient`.
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
    """Cosine of the angle between two gradients."""
    return torch.nn.functional.cosine_similarity(a.flatten(), b.flatten(), dim=0).item()
