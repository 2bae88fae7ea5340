"""Voxel-driven back-projection, which interpolates every view at the image of every voxel, and its
transpose. Derivatives in the cameras use the reference.
"""

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from mvrecon.geometry.lattice import filled, normalised, sample, spread_map
from mvrecon.kernels.operator import LinearKernel
from mvrecon.kernels.self_test import Errors


def backproject_reference(
    views: Float[Tensor, "n m v u"],
    maps: Float[Tensor, "m 4 2 3"],
    window: Sequence[float],
    weighted: bool,
    shape: Sequence[int],
) -> Float[Tensor, "n d h w"]:
    """The sum over cameras of bilinear values at the images of every voxel, in plain torch on any
    device, one camera at a time.

    Args:
        views: values on the detectors, fading to zero over one pixel beyond.
        maps: numerators of u and v about the detector's centre, their denominator, positive on the
            valid side of the source, and the fraction of the ray; each a map of centred voxel
            indices, see `geometry.lattice`.
        window: valid range of a ray's fractions.
        weighted: divide values by the square of the denominator.
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


VOXEL_DRIVEN = LinearKernel(
    "backproject(Tensor views, Tensor maps, float[] window, bool weighted, SymInt[] shape)"
    " -> Tensor",
    "project(Tensor volumes, Tensor maps, float[] window, bool weighted, SymInt[] detector)"
    " -> Tensor",
    None,
    {"cpu": "mvrecon.kernels.voxels.cpu", "cuda": "mvrecon.kernels.voxels.cuda"},
    backproject_reference,
    shapes=(
        lambda views, maps, window, weighted, shape: (views.shape[0], *shape),
        lambda volumes, maps, window, weighted, detector: (
            *(volumes.shape[0], maps.shape[0], *detector),
        ),
    ),
    sizes=(slice(2, 4), slice(1, 4)),
    prefix="voxel_",
)
backproject, project, maps_vjp = VOXEL_DRIVEN.forward, VOXEL_DRIVEN.transpose, VOXEL_DRIVEN.vjp


def self_test(device: str, dtype: torch.dtype, purpose: str) -> Errors:
    """Diverging views with weights."""
    generator = torch.Generator().manual_seed(0)
    maps = 0.05 * torch.randn(3, 4, 2, 3, generator=generator, dtype=torch.float64)
    maps[..., 1, :2] = 0  # images of voxels are projective: no growth along two axes
    maps[:, 0, 0, 0], maps[:, 1, 1, 2], maps[:, 2, 0, 2] = 1.1, 0.9, 1.0
    maps[:, 3] = 0.6 * maps[:, 2]
    y = torch.randn(2, 3, 5, 6, generator=generator).to(device, dtype)
    yield from VOXEL_DRIVEN.self_test(y, maps.to(device), [0.0, 1.0], True, [11, 4, 6])
