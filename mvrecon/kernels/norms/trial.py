"""What the normalisation of a CUDA device is tried on before it is used, against the reference."""

import torch

from mvrecon.kernels.norms import cuda, reference
from mvrecon.kernels.precision import wide
from mvrecon.kernels.self_test import Errors, error_of


def differences(device: str, dtype: torch.dtype, purpose: str) -> Errors:
    """Normalisation of features about a great mean, with its derivatives; features are stored as
    `dtype`.
    """
    generator = torch.Generator().manual_seed(0)
    x = 3 + torch.randn(2, 6, 5, 4, 7, generator=generator)
    x = x.to(device, dtype)
    z = wide(x).detach().requires_grad_()
    scale, shift = torch.randn(2, 6, generator=generator).to(device, z.dtype)
    scale, shift = scale.requires_grad_(), shift.requires_grad_()
    with torch.enable_grad():
        expected = reference.plain(z, scale, shift, 3, 1e-5)
        y = torch.randn(expected.shape, generator=generator).to(z)
        by_x, by_scale, by_shift = torch.autograd.grad((expected * y).sum(), (z, scale, shift))
    answer, sums = cuda.normalised(x, scale, shift, 3, 1e-5)
    yield "normalised_silu", error_of(answer, expected)
    change, back = cuda.change(x, y, scale, shift, sums, 3, 1e-5)
    yield "its derivative", error_of(change, by_x)
    by_items = back.sum(dim=0)
    yield "its derivative by the layer", error_of(by_items, torch.stack((by_shift, by_scale)))
