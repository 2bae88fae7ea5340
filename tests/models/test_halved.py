"""The U-Net's pooling: torch's own numbers, and a derivative that adds up nothing."""

import pytest
import torch
import torch.nn.functional as F
from mvrecon.models.networks import halved

SHAPES = [(4, 6, 8), (5, 6, 7), (2, 3, 3)]


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("shape", SHAPES)
def test_values_and_derivative_have_the_bits_of_torch(shape, dtype):
    torch.manual_seed(0)
    x = torch.randn(2, 3, *shape, dtype=dtype, requires_grad=True)
    expected, found = F.avg_pool3d(x, 2, ceil_mode=True), halved(x)
    onto = torch.randn_like(found)
    assert torch.equal(found, expected)
    assert torch.equal(
        torch.autograd.grad(found, x, onto)[0], torch.autograd.grad(expected, x, onto)[0]
    )


@pytest.mark.parametrize("shape", SHAPES)
def test_first_and_second_derivatives(shape):
    x = torch.randn(1, 2, *shape, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(halved, x)
    assert torch.autograd.gradgradcheck(halved, x)


def test_it_compiles_whole_and_maps_over_an_axis():
    x = torch.randn(4, 2, 3, 5, 6, 7, requires_grad=True)
    compiled = torch.compile(halved, backend="aot_eager", fullgraph=True)
    mapped = torch.stack([halved(one) for one in x])
    assert torch.equal(torch.vmap(halved)(x), mapped)
    (expected,) = torch.autograd.grad(halved(x[0]).square().sum(), x)
    assert torch.equal(torch.autograd.grad(compiled(x[0]).square().sum(), x)[0], expected)
