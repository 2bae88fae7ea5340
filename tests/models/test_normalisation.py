"""Group normalisation and SiLU with channels last in memory."""

import pytest
import torch
import torch.nn.functional as F

from mvrecon.models import normalisation
from mvrecon.models.networks import UNet3d
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


@pytest.mark.parametrize("kernels", [True, False])
def test_half_features_on_a_gpu_give_float32_by_sums_of_float32(kernels, monkeypatch):
    """By the kernels, and where there are none, in as many steps as torch has."""
    monkeypatch.setattr(normalisation, "LARGE", 1)
    if not kernels:
        monkeypatch.setattr(normalisation, "fused_on", lambda _: False)
    norm = torch.nn.GroupNorm(2, 8)
    x = 100 + torch.randn(1, 8, 5, 5).to(torch.bfloat16)
    expected = normalised_silu(norm, x.float())
    with AsGpu() as gpu:
        gpu.put(norm)
        y = normalised_silu(norm, OnGpu(x))
        got = in_memory(y)
        assert got.dtype == torch.float32 and not gpu.waits
        assert gpu.launches["normalised_silu"] == kernels
        before = gpu.launches.total()
        y.sum().backward()
        assert not gpu.waits and norm.weight.grad is not None
    torch.testing.assert_close(got, expected, rtol=1e-4, atol=1e-4)
    assert before == (1 if kernels else 11)


def test_a_network_of_half_numbers_stays_one():
    norm = torch.nn.GroupNorm(2, 8, dtype=torch.bfloat16)
    x = torch.randn(1, 8, 5, 5).to(torch.bfloat16)
    with AsGpu() as gpu:
        gpu.put(norm)
        assert normalised_silu(norm, OnGpu(x)).dtype == torch.bfloat16


def test_no_number_of_a_u_net_on_a_gpu_is_transposed_for_its_normalisation():
    """The same gradients as in main memory, one operator for each normalisation each way, and no
    step of torch's own, whatever the size.
    """
    torch.manual_seed(0)
    network, x = UNet3d(1, 1, width=4, levels=2).double(), torch.randn(1, 1, 8, 8, 8).double()
    network(x).square().sum().backward()
    expected = [p.grad for p in network.parameters()]
    with AsGpu() as gpu:
        gpu.put(network.zero_grad() or network)
        network(OnGpu(x)).square().sum().backward()
    got = [in_memory(p.grad) for p in network.parameters()]
    torch.testing.assert_close(got, expected, rtol=1e-9, atol=1e-11)
    norms = sum(isinstance(layer, torch.nn.GroupNorm) for layer in network.modules())
    assert gpu.launches["normalised_silu"] == gpu.launches["normalised_silu_back"] == norms
    assert not gpu.launches.keys() & {"native_group_norm", "silu"} and not gpu.waits
