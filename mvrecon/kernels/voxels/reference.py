"""The oracle of voxel-driven back-projection: plain torch on any device, one camera at a time."""

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from mvrecon.geometry.lattice import spread_map
from mvrecon.geometry.sample import filled, normalised, sample


def backproject(
    views: Float[Tensor, "n m v u"],
    maps: Float[Tensor, "m 4 2 3"],
    window: Sequence[float],
    weighted: bool,
    shape: Sequence[int],
) -> Float[Tensor, "n d h w"]:
    """What every voxel sees in all views: the sum over cameras of bilinear values at its image.

    Args:
        views: values on the detectors, zero beyond them, fading over one pixel.
        maps: numerators of u and v about the detector's centre, their denominator, positive on the
            side of the source that counts, and the fraction of the ray; each a map of centred voxel
            indices, see `geometry.lattice`.
        window: the fractions of a ray between which it counts.
        weighted: whether values are divided by the denominator's square.
        shape: voxels (d, h, w).
    """
    total = views.new_zeros(len(views), *shape)
    centre = filled([(size - 1) / 2 for size in views.shape[:1:-1]], maps)
    for view, lines in zip(views.unbind(1), maps, strict=True):
        *top, under, fraction = spread_map(lines, (shape[0], shape[1], shape[2])).unbind(dim=-1)
        counts = (under > 0) & (fraction > window[0]) & (fraction < window[1])
        inverse = 1 / torch.where(counts, under, 1.0)
        index = torch.stack(top, dim=-1) * inverse[..., None] + centre
        flat = torch.cat([index, torch.zeros_like(index[..., :1])], dim=-1)
        points = normalised(flat, (1, view.shape[1], view.shape[2]))
        points = torch.where(counts[..., None], points, 4.0).to(view.dtype)
        values = sample(view[None, :, None], points[None])[0]
        total = total + (values * (inverse**2).to(view.dtype) if weighted else values)
    return total
