"""Trilinear sampling. The only caller of `grid_sample`: axis order and corner alignment are settled here.

Convention: coordinates are voxel indices in the order (x, y, z) = (last, middle, first axis of the tensor), integer at
voxel centres. Outside the outermost centres the values fade to zero over one voxel.
"""

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor


def normalised(index: Float[Tensor, "*n 3"], shape: tuple[int, int, int]) -> Float[Tensor, "*n 3"]:
    """Voxel indices as `grid_sample` wants them; points that are not finite or far outside land safely outside."""
    sizes = torch.tensor(shape[::-1], dtype=index.dtype, device=index.device)
    scaled = (2 * index + 1) / sizes - 1
    return torch.where(scaled.isfinite(), scaled, 4.0).clamp(-4.0, 4.0)


def sample(volume: Float[Tensor, "b c d h w"], points: Float[Tensor, "b k v u 3"]) -> Float[Tensor, "b c k v u"]:
    """Values of volumes at normalised points (from `normalised`), zero outside.

    Order of accuracy: second in the voxel size. Coordinates stay float32 or wider whatever the volume's dtype.
    """
    if points.dtype != volume.dtype:
        return F.grid_sample(volume.to(points.dtype), points, align_corners=False).to(volume.dtype)
    return F.grid_sample(volume, points, align_corners=False)


def inside(points: Float[Tensor, "*n 3"]) -> Bool[Tensor, "*n"]:
    """Which normalised points lie in the box of the volume; its faces count, whatever their rounding."""
    return (points.abs() <= 1 + 1e-9).all(dim=-1)
