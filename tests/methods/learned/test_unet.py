"""The U-Net without normalisation: sizes, its start, the numbers that it convolves in, and the
steps between resolutions.
"""

from types import SimpleNamespace

import pytest
import torch
import torch.nn.functional as F

from mvrecon.methods.learned import unet
from mvrecon.methods.learned.unet import (
    MAX_SLOW_SIZE,
    Block,
    PlainUNet,
    arithmetic,
    convolution,
    from_cells,
    halved,
    has_bfloat16,
    padded,
    to_cells,
    trimmed,
)


@pytest.mark.parametrize("sizes", [(1, 1), (5, 7), (1, 1, 1), (3, 1, 6)])
def test_images_and_volumes_of_any_size_keep_it(sizes):
    network = PlainUNet(2 if len(sizes) == 2 else 3, 3, 2, (4, 6, 8))
    answer = network(torch.rand(2, 3, *sizes))
    assert answer.shape == (2, 2, *sizes) and answer.isfinite().all()


def test_only_correction_outputs_are_initially_zero():
    answer = PlainUNet(3, 2, 3, (4, 8), zero=2)(torch.rand(1, 2, 4, 4, 4))
    assert not answer[:, :2].any() and answer[:, 2:].any()


def test_a_block_of_zero_weights_returns_its_input():
    block = Block(torch.nn.Conv2d, 3)
    torch.nn.init.zeros_(block.second.weight)
    x = torch.rand(2, 3, 5, 5)
    assert torch.equal(block(x), x)


def test_coarse_features_cover_the_voxels_of_their_cells():
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


@pytest.mark.parametrize("shape", [(1, 3, 9, 5, 6), (1, 3, 2, 4, 4), (1, 3, 1, 4, 4)])
def test_a_single_small_volume_is_convolved_like_any_other(shape):
    torch.manual_seed(0)
    conv = torch.nn.Conv3d(3, 4, 3, padding=1).double()
    x = torch.randn(shape, dtype=torch.float64, requires_grad=True)
    assert shape[1] * shape[2] * shape[3] <= MAX_SLOW_SIZE
    found, expected = convolution(x, conv.weight, conv.bias), conv(x)
    torch.testing.assert_close(found, expected)
    gradients = [torch.autograd.grad(y.square().sum(), x)[0] for y in (found, expected)]
    torch.testing.assert_close(*gradients)


@pytest.mark.parametrize("shape", [(2, 2, 2), (2, 5, 7), (2, 1, 3), (1, 4, 4), (3, 4, 2)])
@pytest.mark.parametrize("channels", [(8, 16), (16, 16), (32, 32), (64, 64)])
def test_bfloat16_has_the_gradients_of_float32(channels, shape):
    """Within its rounding, whatever memory held before. Also tried: all sizes of 1 to 4 and 7, two
    dimensions, and convolutions of two pixels with strides; two slices alone were wrong.
    """
    gradients, memory = [], torch.channels_last_3d
    x = torch.randn(2, channels[0], *shape).to(memory_format=memory)
    weight = torch.randn(channels[1], channels[0], 3, 3, 3) / 8
    for narrow in (False, True):
        leaves = [tensor.clone().requires_grad_() for tensor in (x, weight)]
        for size in range(4, 19):
            torch.full((1 << size,), 1e30)  # freed at once
        with torch.autocast("cpu", torch.bfloat16, enabled=narrow):
            y = convolution(*leaves)
        gradients.append(torch.autograd.grad(y.float().square().sum(), leaves))
    for exact, rounded in zip(*gradients, strict=True):
        assert (rounded - exact).norm() < 0.03 * exact.norm()


def test_bfloat16_is_used_only_on_request_and_with_hardware_support(monkeypatch):
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
def test_bfloat16_requires_a_multiply_instruction(monkeypatch, names, expected):
    monkeypatch.setattr(
        torch.cpu, "get_capabilities", lambda: dict.fromkeys(names, True), raising=False
    )
    assert has_bfloat16.__wrapped__() is expected


@pytest.mark.parametrize("shape", [(2, 3, 6, 12), (2, 3, 6, 12, 18)])
@pytest.mark.parametrize("edge", [1, 2, 3])
def test_cells_are_split_without_loss(shape, edge):
    x = torch.rand(shape)
    cells = to_cells(x, edge)
    axes = len(shape) - 2
    assert cells.shape == (2, 3 * edge**axes, *(n // edge for n in shape[2:]))
    assert torch.equal(from_cells(cells, edge), x)


def test_cells_of_an_image_have_the_order_of_torch_and_keep_neighbours_together():
    x = torch.rand(2, 3, 6, 4)
    assert torch.equal(to_cells(x, 2), F.pixel_unshuffle(x, 2))
    volume = torch.rand(1, 1, 4, 4, 4)
    block = volume[0, 0, 2:, :2, 2:].flatten()
    assert torch.equal(to_cells(volume, 2)[0, :, 1, 0, 1], block)


@pytest.mark.parametrize("sizes", [(5,), (1, 7), (3, 1, 8)])
def test_padding_appends_zeros_and_is_cropped(sizes):
    x = torch.rand(1, 2, *sizes) + 1
    y = padded(x, 4)
    assert all(n % 4 == 0 for n in y.shape[2:])
    assert torch.equal(trimmed(y, sizes), x)
    assert float(y.double().sum()) == pytest.approx(float(x.double().sum()))


HALVED = [(4, 6, 8), (5, 6, 7), (2, 3, 3)]


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("shape", HALVED)
def test_halving_and_its_derivative_have_the_bits_of_torch(shape, dtype):
    torch.manual_seed(0)
    x = torch.randn(2, 3, *shape, dtype=dtype, requires_grad=True)
    expected, found = F.avg_pool3d(x, 2, ceil_mode=True), halved(x)
    onto = torch.randn_like(found)
    assert torch.equal(found, expected)
    assert torch.equal(
        torch.autograd.grad(found, x, onto)[0], torch.autograd.grad(expected, x, onto)[0]
    )


@pytest.mark.parametrize("shape", HALVED)
def test_halving_has_first_and_second_derivatives(shape):
    x = torch.randn(1, 2, *shape, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(halved, x)
    assert torch.autograd.gradgradcheck(halved, x)


def test_halving_compiles_into_one_graph_and_supports_vmap():
    x = torch.randn(4, 2, 3, 5, 6, 7, requires_grad=True)
    compiled = torch.compile(halved, backend="aot_eager", fullgraph=True)
    mapped = torch.stack([halved(one) for one in x])
    assert torch.equal(torch.vmap(halved)(x), mapped)
    (expected,) = torch.autograd.grad(halved(x[0]).square().sum(), x)
    assert torch.equal(torch.autograd.grad(compiled(x[0]).square().sum(), x)[0], expected)


@pytest.mark.parametrize("shape", [(1, 4, 3), (1, 1, 1), (5, 2, 1)])
def test_halving_keeps_an_axis_of_one_voxel(shape):
    x = torch.rand(2, 3, *shape, dtype=torch.float64, requires_grad=True)
    assert halved(x).shape[2:] == tuple(-(-n // 2) for n in shape)
    mean = x[:, :, :2, :2, :2].mean(dim=(2, 3, 4))
    torch.testing.assert_close(halved(x)[:, :, 0, 0, 0], mean)
    assert torch.autograd.gradcheck(halved, [x])
