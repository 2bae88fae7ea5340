"""Voxel-driven back-projection, in which every voxel looks up its own image in every view, and its
transpose. Derivatives in the cameras are the reference's.
"""

import torch

from mvrecon.kernels.operator import LinearKernel
from mvrecon.kernels.self_test import Errors
from mvrecon.kernels.voxels import reference

VOXEL_DRIVEN = LinearKernel(
    "backproject(Tensor views, Tensor maps, float[] window, bool weighted, SymInt[] shape)"
    " -> Tensor",
    "project(Tensor volumes, Tensor maps, float[] window, bool weighted, SymInt[] detector)"
    " -> Tensor",
    None,
    {"cpu": "mvrecon.kernels.voxels.cpu", "cuda": "mvrecon.kernels.voxels.cuda"},
    reference.backproject,
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
    maps[..., 1, :2] = 0  # images of voxels are projective, so nothing grows along two axes
    maps[:, 0, 0, 0], maps[:, 1, 1, 2], maps[:, 2, 0, 2] = 1.1, 0.9, 1.0
    maps[:, 3] = 0.6 * maps[:, 2]
    y = torch.randn(2, 3, 5, 6, generator=generator).to(device, dtype)
    yield from VOXEL_DRIVEN.self_test(y, maps.to(device), [0.0, 1.0], True, [11, 4, 6])
