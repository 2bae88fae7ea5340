"""Trilinear sampling. The only caller of `grid_sample`: axis order and corner alignment are settled
here.

Convention: coordinates are voxel indices in the order (x, y, z) = (last, middle, first axis of the
tensor), integer at voxel centres. Outside the outermost centres the values fade to zero over one
voxel.
"""

from collections.abc import Sequence
from itertools import product

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor


def filled(values: Sequence[float], like: Tensor) -> Float[Tensor, " n"]:
    """Some numbers as a tensor of another one's device and type, written there: a GPU need not be
    waited for, as it would for a copy.
    """
    return torch.stack([like.new_full((), value) for value in values])


def normalised(index: Float[Tensor, "*n 3"], shape: tuple[int, int, int]) -> Float[Tensor, "*n 3"]:
    """Voxel indices as `grid_sample` wants them; points that are not finite or far outside land
    safely outside.
    """
    sizes = filled(shape[::-1], index)
    scaled = (2 * index + 1) / sizes - 1
    return torch.where(scaled.isfinite(), scaled, 4.0).clamp(-4.0, 4.0)


def sample(
    volume: Float[Tensor, "b c d h w"], points: Float[Tensor, "b k v u 3"]
) -> Float[Tensor, "b c k v u"]:
    """Values of volumes at normalised points (from `normalised`), zero outside.

    Order of accuracy: second in the voxel size. Coordinates stay float32 or wider whatever the
    volume's dtype.
    """
    if points.dtype != volume.dtype:
        return sample(volume.to(points.dtype), points).to(volume.dtype)
    if torch.are_deterministic_algorithms_enabled() and not volume.is_cpu:
        return gathered(volume, points)
    return F.grid_sample(volume, points, align_corners=False)


def gathered(
    volume: Float[Tensor, "b c d h w"], points: Float[Tensor, "b k v u 3"]
) -> Float[Tensor, "b c k v u"]:
    """What `grid_sample` gives, whose derivative on a GPU adds up in no fixed order; that of
    `gather` can.
    """
    places = ((points + 1) * filled(volume.shape[:1:-1], points) - 1) / 2
    low, flat = places.detach().floor(), volume.flatten(2)
    sizes = filled(volume.shape[:1:-1], low).long()
    values = volume.new_zeros(*volume.shape[:2], *points.shape[1:4])
    for corner in product((0, 1), repeat=3):
        at = (low + filled(corner, low)).long()
        inside = ((at >= 0) & (at < sizes)).all(dim=-1)
        x, y, z = at.where(inside[..., None], 0).unbind(dim=-1)
        index = (
            ((z * sizes[1] + y) * sizes[0] + x).flatten(1)[:, None].expand(-1, flat.shape[1], -1)
        )
        along_x, along_y, along_z = (1 - (places - at).abs()).unbind(dim=-1)
        share = along_x * along_y * along_z * inside
        values = values + flat.gather(2, index).unflatten(2, inside.shape[1:]) * share[:, None]
    return values
