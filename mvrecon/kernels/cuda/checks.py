"""What these kernels are tried on before they are used on a device, against the reference."""

import torch
from torch import Tensor

from mvrecon.geometry.lattice import lifted_maps
from mvrecon.kernels.cuda import voxels, warps
from mvrecon.kernels.rays.cuda.selfcheck import Tried, error_of
from mvrecon.kernels.voxels import reference as voxel_reference
from mvrecon.kernels.warps import reference as warp_reference


def warp_differences(device: str, dtype: torch.dtype) -> Tried:
    """Warps between lattices that diverge, with their transpose and derivative by the maps."""
    noise = _noise()
    H = torch.eye(4).double() + 0.1 * noise(2, 3, 4, 4)
    lifts = torch.tensor([[1.0, 0.05], [0.9, 0.1], [1.0, 0.0]], dtype=torch.float64)
    maps = lifted_maps(H, lifts[:2, None], lifts).to(device).requires_grad_()
    x = noise(2, 2, 3, 4, 5, 6).to(device, dtype).requires_grad_()
    shape = [5, 4, 7]
    with torch.enable_grad():
        values = warp_reference.warp(x, maps, shape)
        y = noise(*values.shape).to(values)
        volumes, change = torch.autograd.grad((values * y).sum(), (x, maps))
    yield "warp", error_of(warps.warp(x, maps, shape), values)
    yield "warp_back", error_of(warps.warp_back(y, maps, x.shape[3:]), volumes)
    yield "warp_vjp", error_of(warps.warp_vjp(x, y, maps), change)


def look_differences(device: str, dtype: torch.dtype) -> Tried:
    """Voxel-driven back-projection of diverging views with weights, and its transpose."""
    noise = _noise()
    maps = 0.05 * noise(3, 4, 2, 3).to(device)
    maps[..., 1, :2] = 0  # images of voxels are projective, so nothing grows along two axes
    maps[:, 0, 0, 0], maps[:, 1, 1, 2], maps[:, 2, 0, 2] = 1.1, 0.9, 1.0
    maps[:, 3] = 0.6 * maps[:, 2]
    y = noise(2, 3, 5, 6).to(device, dtype).requires_grad_()
    rest, shape = (maps, [0.0, 1.0], True), [11, 4, 6]
    with torch.enable_grad():
        volumes = voxel_reference.look(y, *rest, shape)
        x = noise(*volumes.shape).to(volumes)
        (views,) = torch.autograd.grad((volumes * x).sum(), y)
    yield "look", error_of(voxels.look(y, *rest, shape), volumes)
    yield "show", error_of(voxels.show(x, *rest, y.shape[2:]), views)


def _noise():
    generator = torch.Generator().manual_seed(0)

    def noise(*shape: int) -> Tensor:
        return torch.rand(shape, generator=generator, dtype=torch.float64) * 2 - 1

    return noise


#: What is tried, by the purpose of kernels.
CHECKS = {"warp": warp_differences, "look": look_differences}
