"""The U-Net without normalisation: sizes, its start, and the numbers that it convolves in."""

from types import SimpleNamespace

import pytest
import torch
from mvrecon.models.cross_view.unet import Block, PlainUNet, arithmetic
from mvrecon.models.networks import convolution

from mvrecon.models.cross_view import unet


@pytest.mark.parametrize("sizes", [(1, 1), (5, 7), (1, 1, 1), (3, 1, 6)])
def test_images_and_volumes_of_any_size_keep_it(sizes):
    network = PlainUNet(2 if len(sizes) == 2 else 3, 3, 2, (4, 6, 8))
    answer = network(torch.rand(2, 3, *sizes))
    assert answer.shape == (2, 2, *sizes) and answer.isfinite().all()


def test_outputs_that_correct_start_at_zero_and_the_others_do_not():
    answer = PlainUNet(3, 2, 3, (4, 8), zero=2)(torch.rand(1, 2, 4, 4, 4))
    assert not answer[:, :2].any() and answer[:, 2:].any()


def test_a_block_of_no_weights_leaves_its_input():
    block = Block(torch.nn.Conv2d, 3)
    torch.nn.init.zeros_(block.second.weight)
    x = torch.rand(2, 3, 5, 5)
    assert torch.equal(block(x), x)


def test_coarse_features_belong_to_the_voxels_of_their_cells():
    """Without blocks a voxel depends on its own cell of 4 x 4 x 4 voxels alone, also where cells
    stand beyond the volume."""
    torch.manual_seed(0)
    network = PlainUNet(3, 1, 1, (4, 6, 8))
    for block in (*network.down, *network.up):
        torch.nn.init.zeros_(block.second.weight)
    coarse = torch.rand(1, 8, 3, 3, 3, requires_grad=True)
    answer = network(torch.rand(1, 1, 9, 10, 11), {2: coarse})
    (gradient,) = torch.autograd.grad(answer[0, 0, 3, 4, 10], coarse)
    assert (gradient != 0).any(dim=1).nonzero().tolist() == [[0, 0, 1, 2]]


def test_without_normalisation_an_offset_of_the_input_is_not_lost():
    """The answer to a brighter volume is another one; group normalisation would hide most of it."""
    torch.manual_seed(0)
    network = PlainUNet(3, 1, 1, (4, 8))
    x = torch.rand(1, 1, 8, 8, 8)
    assert (network(x + 10) - network(x)).abs().min() > 1e-3


def test_a_volume_that_is_alone_is_convolved_with_the_same_offset():
    torch.manual_seed(0)
    conv = torch.nn.Conv3d(3, 4, 3, padding=1).double()
    x = torch.rand(1, 3, 7, 6, 5, dtype=torch.float64)
    assert torch.allclose(convolution(x, conv.weight, conv.bias), conv(x), rtol=1e-12)


def test_bfloat16_is_taken_only_where_the_processor_has_it_and_it_is_asked_for(monkeypatch):
    torch.manual_seed(0)
    network = PlainUNet(2, 2, 1, (4, 8), precision="auto").eval()
    x = torch.rand(1, 2, 8, 8)
    with torch.no_grad():
        monkeypatch.setattr(unet, "has_bfloat16", lambda: False)
        exact = network(x)
        monkeypatch.setattr(unet, "has_bfloat16", lambda: True)
        narrow = network(x)
        assert narrow.dtype == torch.float32
        difference = (narrow - exact).abs().max() / exact.abs().max()
        assert 0 < difference < 0.05
        network.precision = "float32"
        assert torch.equal(network(x), exact)
    with arithmetic("auto", x.double()):
        assert not torch.is_autocast_enabled("cpu")


@pytest.mark.parametrize(("capability", "narrow"), [((7, 5), False), ((8, 0), True)])
def test_a_gpu_convolves_in_bfloat16_from_ampere_on(capability, narrow, monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "is_bf16_supported", lambda *_, **__: narrow)
    monkeypatch.setattr(torch.cuda, "get_device_capability", lambda _: capability)
    x = SimpleNamespace(
        is_cpu=False, is_cuda=True, dtype=torch.float32, device=torch.device("cuda", 7)
    )
    unet.gpu_has_bfloat16.cache_clear()
    context = arithmetic("auto", x)
    unet.gpu_has_bfloat16.cache_clear()
    if narrow:
        assert (context.device, context.fast_dtype) == ("cuda", torch.bfloat16)
    else:
        assert not isinstance(context, torch.autocast)


@pytest.mark.parametrize(
    ("names", "expected"),
    [(("amx_bf16",), True), (("avx512_bf16",), True), (("avx512_f",), False), ((), False)],
)
def test_bfloat16_needs_an_instruction_that_multiplies_it(monkeypatch, names, expected):
    monkeypatch.setattr(
        torch.cpu, "get_capabilities", lambda: dict.fromkeys(names, True), raising=False
    )
    assert unet.has_bfloat16.__wrapped__() is expected
