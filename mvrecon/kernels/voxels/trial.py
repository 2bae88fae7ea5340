"""What the voxel-driven back-projection of a CUDA device is tried on before it is used, against the
reference.
"""

import torch

from mvrecon.kernels.rays.cuda.selfcheck import Tried, error_of
from mvrecon.kernels.voxels import cuda, reference


def differences(device: str, dtype: torch.dtype) -> Tried:
    """Voxel-driven back-projection of diverging views with weights, and its transpose."""
    generator = torch.Generator().manual_seed(0)
    maps = 0.05 * torch.randn(3, 4, 2, 3, generator=generator, dtype=torch.float64)
    maps[..., 1, :2] = 0  # images of voxels are projective, so nothing grows along two axes
    maps[:, 0, 0, 0], maps[:, 1, 1, 2], maps[:, 2, 0, 2] = 1.1, 0.9, 1.0
    maps[:, 3] = 0.6 * maps[:, 2]
    rest, shape = (maps.to(device), [0.0, 1.0], True), [11, 4, 6]
    y = torch.randn(2, 3, 5, 6, generator=generator).to(device, dtype).requires_grad_()
    with torch.enable_grad():
        volumes = reference.look(y, *rest, shape)
        x = torch.randn(volumes.shape, generator=generator).to(volumes)
        (views,) = torch.autograd.grad((volumes * x).sum(), y)
    yield "look", error_of(cuda.look(y, *rest, shape), volumes)
    yield "show", error_of(cuda.show(x, *rest, y.shape[2:]), views)
