"""What the warps of a CUDA device are tried on before they are used, against the reference."""

import torch

from mvrecon.geometry.lattice import lifted_maps
from mvrecon.kernels.precision import wide
from mvrecon.kernels.rays.cuda.selfcheck import Tried, error_of
from mvrecon.kernels.warps import cuda, reference


def differences(device: str, dtype: torch.dtype) -> Tried:
    """Warps between lattices that diverge, with their transpose and derivative by the maps; volumes
    and values are stored as `dtype`.
    """
    generator = torch.Generator().manual_seed(0)
    H = torch.randn(2, 3, 4, 4, generator=generator, dtype=torch.float64)
    lifts = torch.tensor([[1.0, 0.05], [0.9, 0.1], [1.0, 0.0]], dtype=torch.float64)
    maps = lifted_maps(torch.eye(4).double() + 0.05 * H, lifts[:2, None], lifts)
    maps = maps.to(device).requires_grad_()
    x = torch.randn(2, 2, 3, 4, 5, 6, generator=generator).to(device, dtype)
    z = wide(x).detach().requires_grad_()
    shape = [5, 4, 7]
    with torch.enable_grad():
        values = reference.warp(z, maps, shape)
        y = torch.randn(values.shape, generator=generator).to(x)
        volumes, change = torch.autograd.grad((values * wide(y)).sum(), (z, maps))
    yield "warp", error_of(cuda.warp(x, maps, shape), values)
    yield "warp_back", error_of(cuda.warp_back(y, maps, x.shape[3:]), volumes)
    yield "warp_vjp", error_of(cuda.warp_vjp(x, y, maps), change)
