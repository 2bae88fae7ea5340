"""Steps on a mask's voxels against sums over them, and against the plain steps where everything is
masked in.
"""

import pytest
import torch
import torch.nn.functional as F
from mvrecon.models.networks import upsampled
from mvrecon.models.sparse import convolved, doubled, group_norm, halved, pyramid, voxels_of

from tests.models.dense import normalised, pooled


def _some(
    n: int = 2, c: int = 6, shape: tuple[int, ...] = (5, 6, 11)
) -> tuple[torch.Tensor, torch.Tensor]:
    torch.manual_seed(0)
    return torch.randn(n, c, *shape, dtype=torch.float64), torch.rand(n, 1, *shape) > 0.6


def test_rows_are_the_voxels_sample_by_sample():
    x, mask = _some()
    on = voxels_of(mask)
    rows = on.pick(x)
    assert on.counts == mask.flatten(1).sum(dim=1).tolist() and len(rows) == mask.sum()
    assert torch.equal(on.put(rows), x * mask) and torch.equal(on.mask, mask)
    for sample, part in zip(x, rows.split(on.counts), strict=True):
        assert {tuple(row.tolist()) for row in part} <= {
            tuple(row.tolist()) for row in sample.flatten(1).T
        }


@pytest.mark.parametrize("shape", [(5, 6, 11), (4, 4, 8), (1, 9, 3)])
def test_a_convolution_takes_all_else_for_zero(shape):
    x, mask = _some(shape=shape)
    weight, on = torch.randn(5, 6, 3, 3, 3, dtype=torch.float64), voxels_of(mask)
    expected = F.conv3d(x * mask, weight, padding=1) * mask
    assert torch.allclose(on.put(convolved(on.pick(x), weight, on)), expected, atol=1e-12)


def test_normalisation_is_by_the_voxels_of_each_sample_and_group():
    x, mask = _some()
    norm, on = torch.nn.GroupNorm(3, 6, dtype=torch.float64), voxels_of(mask)
    norm.weight.data.uniform_(), norm.bias.data.normal_()
    rows = group_norm(on.pick(x), on.counts, 3, (norm.weight, norm.bias), norm.eps)
    assert torch.allclose(on.put(rows), normalised(x, mask.double(), norm), atol=1e-12)


def test_an_offset_costs_the_variance_no_digits():
    x, mask = _some(1, 4, (16, 16, 16))
    affine, on = (torch.ones(4), torch.zeros(4)), voxels_of(mask)
    moved, still = (
        group_norm(on.pick(x + shift).float(), on.counts, 2, affine) for shift in (1000.0, 0.0)
    )
    assert torch.allclose(moved, still, atol=2e-3)


@pytest.mark.parametrize("shape", [(5, 6, 11), (2, 3, 4)])
def test_halving_and_doubling_are_means_over_what_is_in_the_mask(shape):
    x, mask = _some(shape=shape)
    fine, coarse = pyramid(mask, 2)
    expected, held = pooled(x, mask.double())
    rows = halved(fine.pick(x), fine, coarse)
    assert torch.equal(coarse.mask, held > 0) and torch.allclose(
        coarse.put(rows), expected, atol=1e-12
    )
    whole = upsampled(expected, held, mask.double(), [2 * n for n in held.shape[2:]])
    assert torch.allclose(fine.put(doubled(rows, coarse, fine)), whole, atol=1e-12)


def test_a_mask_of_ones_gives_the_plain_steps():
    x, _ = _some(shape=(6, 4, 8))
    fine, coarse = pyramid(torch.ones_like(x[:, :1]).bool(), 2)
    norm, rows = torch.nn.GroupNorm(3, 6, dtype=torch.float64), fine.pick(x)
    found = fine.put(group_norm(rows, fine.counts, 3, (norm.weight, norm.bias)))
    assert torch.allclose(found, norm(x), atol=1e-12)
    half = halved(rows, fine, coarse)
    assert torch.allclose(coarse.put(half), F.avg_pool3d(x, 2), atol=1e-12)
    whole = F.interpolate(F.avg_pool3d(x, 2), scale_factor=2, mode="trilinear")
    assert torch.allclose(fine.put(doubled(half, coarse, fine)), whole, atol=1e-12)


def test_halving_and_doubling_of_a_constant_keep_it():
    _, mask = _some()
    fine, coarse = pyramid(mask, 2)
    half = halved(torch.full((len(fine.place), 1), 3.0), fine, coarse)
    assert torch.allclose(half, torch.tensor(3.0)) and len(half) == coarse.mask.sum()
    assert torch.allclose(doubled(half, coarse, fine), torch.tensor(3.0))


def test_an_empty_mask_has_no_rows():
    x, mask = _some()
    fine, coarse = pyramid(torch.zeros_like(mask), 2)
    rows = group_norm(
        fine.pick(x), fine.counts, 3, (torch.ones(6).double(), torch.ones(6).double())
    )
    rows = convolved(rows, torch.ones(6, 6, 3, 3, 3).double(), fine)
    rows = doubled(halved(rows, fine, coarse), coarse, fine)
    assert fine.counts == [0, 0] and rows.shape == (0, 6) and not fine.put(rows).any()


@pytest.mark.parametrize("step", ["conv", "norm", "half", "double", "put"])
def test_gradients_are_those_of_differences(step):
    x, mask = _some(2, 2, (3, 4, 2))
    fine, coarse = pyramid(mask, 2)
    rows = (coarse if step == "double" else fine).pick(
        F.avg_pool3d(x, 2, ceil_mode=True) if step == "double" else x
    )
    scale, weight = torch.rand(2).double(), torch.randn(2, 2, 3, 3, 3).double()
    steps = {
        "conv": (lambda x, weight: convolved(x, weight, fine), weight),
        "norm": (lambda x, scale: group_norm(x, fine.counts, 1, (scale, 1 - scale)), scale),
        "half": (lambda x: halved(x, fine, coarse),),
        "double": (lambda x: doubled(x, coarse, fine),),
        "put": (fine.put,),
    }
    done, *others = steps[step]
    assert torch.autograd.gradcheck(
        done, [given.detach().requires_grad_() for given in (rows, *others)]
    )
