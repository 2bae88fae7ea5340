"""What kernels of attenuated rays are tried on before their first use on a device."""

import torch

from mvrecon.kernels.precision import arithmetic
from mvrecon.kernels.rays import attenuated_reference as reference
from mvrecon.kernels.rays.cuda import attenuated as cuda
from mvrecon.kernels.rays.cuda.selfcheck import Tried, error_of, tiny_scene


def differences(device: str, dtype: torch.dtype) -> Tried:
    """Views in two layers, their transpose and derivative by attenuation, of either method."""
    lines, window, detector, shape = tiny_scene(device)
    generator, real = torch.Generator().manual_seed(0), arithmetic(dtype)
    x = torch.rand(2, *shape, generator=generator).to(device, real)
    y = torch.rand(2, len(lines), *detector, 2, generator=generator).to(device, real)
    mu = (0.2 * torch.rand(shape, generator=generator)).to(device, real).requires_grad_()
    layers = torch.tensor([[1.2, 2.5]], dtype=torch.float64).expand(len(lines), -1).to(device)
    for method in reference.CELLS:
        with torch.enable_grad():
            views = reference.project(x, mu, lines, layers, window, detector, method)
            (change,) = torch.autograd.grad((views * y).sum(), mu)
        rays, fixed = (lines, layers, window), mu.detach()
        volume = reference.backproject(y, fixed, *rays, method)
        yield "project", error_of(cuda.project(x, fixed, *rays, detector, method), views)
        yield "backproject", error_of(cuda.backproject(y, fixed, *rays, method), volume)
        yield "mu_vjp", error_of(cuda.mu_vjp(x, y, fixed, *rays, method), change)
