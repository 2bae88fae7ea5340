"""The steps of a masked network against sums over voxels, and against the plain steps where everything is masked in."""

import pytest
import torch
import torch.nn.functional as F

from mvrecon.models.masks import group_norm, pooled, upsampled


def _some(n: int = 2, c: int = 6, shape: tuple[int, ...] = (5, 4, 7)) -> tuple[torch.Tensor, torch.Tensor]:
    torch.manual_seed(0)
    return torch.randn(n, c, *shape, dtype=torch.float64), (torch.rand(n, 1, *shape) > 0.6).double()


def test_normalisation_is_by_the_masked_voxels_of_each_sample_and_group():
    x, mask = _some()
    scale, shift = torch.rand(6).double(), torch.randn(6).double()
    expected = torch.zeros_like(x)
    for n in range(2):
        inside = mask[n, 0].bool()
        for first in (0, 2, 4):
            held = x[n, first : first + 2, inside]
            plain = (held - held.mean()) / (held.var(unbiased=False) + 1e-5).sqrt()
            expected[n, first : first + 2, inside] = (
                plain * scale[first : first + 2, None] + shift[first : first + 2, None]
            )
    assert torch.allclose(group_norm(x, mask, 3, (scale, shift)), expected, atol=1e-12)


def test_what_lies_outside_the_mask_does_not_matter_to_normalisation():
    x, mask = _some()
    affine = torch.ones(6).double(), torch.ones(6).double()
    other = torch.where(mask > 0, x, 1e3)
    assert torch.equal(group_norm(x, mask, 2, affine), group_norm(other, mask, 2, affine))


def test_an_offset_costs_the_variance_no_digits():
    x, mask = _some(1, 4, (16, 16, 16))
    affine = torch.ones(4), torch.zeros(4)
    moved = group_norm((x + 1000).float(), mask.float(), 2, affine)
    assert torch.allclose(moved, group_norm(x.float(), mask.float(), 2, affine), atol=2e-3)


def test_a_mask_of_ones_gives_the_plain_steps():
    x, _ = _some()
    ones = torch.ones_like(x[:, :1])
    norm = torch.nn.GroupNorm(3, 6, dtype=torch.float64)
    norm.weight.data.normal_(), norm.bias.data.normal_()
    assert torch.allclose(group_norm(x, ones, 3, (norm.weight, norm.bias)), norm(x), atol=1e-12)
    coarse, held = pooled(x, ones)
    assert torch.equal(coarse, F.avg_pool3d(x, 2, ceil_mode=True)) and held.all()
    fine = torch.ones(2, 1, 6, 4, 8).double()
    assert torch.allclose(
        upsampled(coarse, held, fine, (6, 4, 8)), F.interpolate(coarse, scale_factor=2, mode="trilinear"), atol=1e-12
    )


def test_an_empty_mask_gives_zeros():
    x, mask = _some()
    none = torch.zeros_like(mask)
    assert not group_norm(x, none, 3, (torch.ones(6).double(), torch.ones(6).double())).any()
    coarse, held = pooled(x * none, none)
    assert not coarse.any() and not held.any()
    assert not upsampled(coarse, held, none, [2 * n for n in held.shape[2:]]).any()


def test_pooling_and_upsampling_of_a_constant_keep_it_everywhere_in_the_mask():
    _, mask = _some()
    coarse, held = pooled(3.0 * mask, mask)
    assert torch.allclose(coarse, 3.0 * held, atol=1e-12)
    assert torch.equal(held[:, :, 0, 0, 0], mask[:, :, :2, :2, :2].amax(dim=(2, 3, 4)))
    back = upsampled(coarse, held, mask, [2 * n for n in held.shape[2:]])
    assert torch.allclose(back, 3.0 * mask, atol=1e-12)


@pytest.mark.parametrize("step", ["norm", "pool", "up"])
def test_gradients_are_those_of_differences(step):
    x, mask = _some(1, 2, (3, 4, 2))
    x.requires_grad_()
    affine = torch.rand(2).double().requires_grad_(), torch.rand(2).double().requires_grad_()
    wide = torch.ones(1, 1, 6, 8, 4).double()
    steps = {
        "norm": lambda x, *affine: group_norm(x, mask, 1, affine),
        "pool": lambda x, *_: pooled(x * mask, mask)[0],
        "up": lambda x, *_: upsampled(x, mask, F.interpolate(mask, scale_factor=2) * wide, (6, 8, 4)),
    }
    assert torch.autograd.gradcheck(steps[step], (x, *affine))
