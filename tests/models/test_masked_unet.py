"""A masked network does not depend on the empty space around its mask, and is what its definition
says.
"""

from functools import partial

import pytest
import torch
import torch.nn.functional as F
from mvrecon.models.networks import ALONE, ConvBlock, UNet3d, convolution

from tests.models.dense import net_on

TOLERANCE = {torch.float32: 1e-5, torch.float64: 1e-12}


def _net(dtype: torch.dtype = torch.float32) -> UNet3d:
    torch.manual_seed(0)
    net = UNet3d(3, 2, 4).to(dtype)
    for parameter in net.parameters():
        parameter.data += 0.1 * torch.randn_like(parameter)
    return net


def _blob(shape: tuple[int, int, int] = (12, 16, 12)) -> torch.Tensor:
    """Two different masks that reach the faces of their box."""
    torch.manual_seed(1)
    mask = F.max_pool3d((torch.rand(2, 1, *shape) > 0.97).double(), 3, stride=1, padding=1) > 0
    assert mask[..., 0, :, :].any() and mask[..., -1].any() and not mask.all()
    return mask


def _close(a: torch.Tensor, b: torch.Tensor, tolerance: float) -> bool:
    return bool(b.abs().max() > 0.1) and bool((a - b).abs().max() <= tolerance * b.abs().max())


@pytest.mark.parametrize("dtype", list(TOLERANCE))
def test_empty_space_around_the_mask_changes_nothing(dtype):
    net, mask = _net(dtype), _blob()
    x = torch.randn(2, 3, *mask.shape[2:], dtype=dtype)
    alone = net(x, mask)
    for before, behind in ((4, 0), (4, 8), (8, 3)):  # 2^(levels - 1) = 4; behind, any number
        wide = [before, behind] * 3
        larger = net(F.pad(x, wide, value=7.0), F.pad(mask, wide))
        inner = larger[:, :, *(slice(before, before + n) for n in mask.shape[2:])]
        assert _close(inner, alone, TOLERANCE[dtype])
        assert not (alone * ~mask).any() and torch.count_nonzero(larger) == torch.count_nonzero(
            inner
        )


def test_a_shift_that_moves_coarse_voxels_does_change_it():
    net, mask = _net(), _blob()
    x = torch.randn(2, 3, *mask.shape[2:])
    moved = net(F.pad(x, [1] * 6), F.pad(mask, [1] * 6))[:, :, 1:-1, 1:-1, 1:-1]
    assert not _close(moved, net(x, mask), 1e-3)


def test_a_batch_is_its_samples():
    net, mask = _net(), _blob()
    x = torch.randn(2, 3, *mask.shape[2:])
    single = torch.cat([net(x[i : i + 1], mask[i : i + 1]) for i in range(2)])
    assert _close(net(x, mask), single, 1e-5)


def test_a_mask_of_ones_is_no_mask():
    net, x = _net(), torch.randn(2, 3, 12, 8, 16)
    assert _close(net(x, torch.ones(2, 1, 12, 8, 16, dtype=torch.bool)), net(x), 1e-5)


def test_rows_are_the_dense_masked_network_with_its_gradients():
    net, mask = _net(torch.float64), F.pad(_blob((9, 8, 7)), [0, 17, 4, 4, 10, 5])
    mask[1, :, :12] = False
    x, found = torch.randn(2, 3, *mask.shape[2:], dtype=torch.float64), []
    for done in (net, partial(net_on, net)):
        net.zero_grad()
        given = x.clone().requires_grad_()
        out = done(given, mask)
        out.square().mean().backward()
        found.append([out, given.grad, *(p.grad for p in net.parameters())])
    for rows, dense in zip(*found, strict=True):
        assert dense.any() and (rows - dense).abs().max() <= 1e-12 * dense.abs().max()


def test_a_sample_with_no_voxel_is_zero_and_leaves_the_other_alone():
    net, mask = _net(), _blob()
    x, both = torch.randn(2, 3, *mask.shape[2:]), mask.clone()
    both[1] = False
    out = net(x, both)
    assert _close(out[:1], net(x[:1], mask[:1]), 1e-5) and not out[1].any()
    assert not net(x, torch.zeros_like(mask)).any()


@pytest.mark.parametrize(
    "shape", [(1, 3, 9, 5, 6), (1, 3, 2, 4, 4), (1, 3, 1, 4, 4), (2, 3, 6, 6, 6)]
)
def test_a_small_volume_alone_is_convolved_as_any_other(shape):
    torch.manual_seed(0)
    x, weight = (
        torch.randn(shape, dtype=torch.float64, requires_grad=True),
        torch.randn(4, 3, 3, 3, 3).double(),
    )
    assert shape[1] * shape[2] * shape[3] <= ALONE
    assert torch.allclose(convolution(x, weight), F.conv3d(x, weight, padding=1), atol=1e-12)
    (found,), (dense,) = (
        torch.autograd.grad(f.square().sum(), x)
        for f in (convolution(x, weight), F.conv3d(x, weight, padding=1))
    )
    assert torch.allclose(found, dense, atol=1e-10)


def test_without_a_mask_a_block_is_its_layers():
    torch.manual_seed(0)
    block, x = ConvBlock(3, 4), torch.randn(1, 3, 8, 8, 8)
    first = block.first(x)
    # a small volume that is alone is convolved as two halves
    assert torch.allclose(block(x), first + block.second(first), rtol=0, atol=1e-5)
