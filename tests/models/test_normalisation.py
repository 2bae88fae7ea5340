"""Group normalisation and SiLU with channels last in memory."""

import pytest
import torch
import torch.nn.functional as F

from mvrecon.models import normalisation
from mvrecon.models.normalisation import in_any_order, normalised_silu
from mvrecon.testing.as_gpu import AsGpu, OnGpu, in_memory

ORDERS = {4: torch.channels_last, 5: torch.channels_last_3d}


@pytest.mark.parametrize("shape", [(2, 12, 4, 3, 5), (3, 4, 6, 5), (1, 4, 1, 1)], ids=str)
def test_it_is_torch_s_and_what_it_makes_lies_in_memory_as_its_input(shape):
    """Values and derivatives, of a group of one value, too; no transposition either way."""
    torch.manual_seed(0)
    norm, order = torch.nn.GroupNorm(4, shape[1]).double(), ORDERS[len(shape)]
    for parameter in norm.parameters():
        torch.nn.init.normal_(parameter)
    x, change = (one.contiguous(memory_format=order) for one in torch.randn(2, *shape).double() + 3)
    x.requires_grad_()
    results = []
    for act in (lambda: F.silu(in_any_order(norm, x)), lambda: normalised_silu(norm, x)):
        y = act()
        results.append((y, *torch.autograd.grad(y, (x, norm.weight, norm.bias), change)))
    for got, expected in zip(*results, strict=True):
        torch.testing.assert_close(got, expected, rtol=1e-10, atol=1e-12)
    assert all(one.is_contiguous(memory_format=order) for one in results[0][:2])


def test_half_features_on_a_gpu_give_float32_by_sums_of_float32(monkeypatch):
    monkeypatch.setattr(normalisation, "LARGE", 1)
    norm = torch.nn.GroupNorm(2, 8)
    x = 100 + torch.randn(1, 8, 5, 5).to(torch.bfloat16)
    expected = normalised_silu(norm, x.float())
    with AsGpu() as gpu:
        gpu.put(norm)
        got = in_memory(normalised_silu(norm, OnGpu(x)))
    assert got.dtype == torch.float32 and not gpu.waits
    torch.testing.assert_close(got, expected, rtol=1e-4, atol=1e-4)
