"""Resampling: exact for linear fields, and conserves total attenuation."""

from itertools import pairwise

import pytest
import torch
import torch.nn.functional as F

from mvrecon.data import resample as module
from mvrecon.data.resample import Slabs, pooled, resample
from mvrecon.geometry.grid import Box, Grid, voxel_centres
from mvrecon.geometry.rigid import euler_rotation

SOURCE = Grid.centred(size=(44, 40, 30), spacing=(2.0, 2.2, 3.0), centre=(5.0, 0.0, -4.0))


def plane(grid):
    return (voxel_centres(grid) @ torch.tensor([0.3, -0.2, 0.1], dtype=torch.float64) + 7).float()


def turned(grid, degrees):
    rotation = euler_rotation(degrees, "xyz")
    return grid.moved(rotation, grid.centre - rotation @ grid.centre)


@pytest.mark.parametrize("spacing", [0.9, 2.0, 3.1, 4.5, 7.0])
def test_a_linear_field_is_resampled_exactly_to_turned_axes(spacing):
    count = int(36 / spacing)
    target = turned(Grid.centred((count,) * 3, spacing, centre=(3.0, 1.0, -2.0)), (20, -10, 30))
    assert torch.allclose(resample(plane(SOURCE), SOURCE, target), plane(target), atol=2e-5)


@pytest.mark.parametrize("nudge", [1e-13, -1e-13, 1e-10, -1e-10])
def test_rounding_does_not_decide_the_points_in_a_voxel(nudge):
    """Of target voxels one and a half times as large. Also tried: 1, 2, 2.5, 3 and 3.5 times."""
    values = torch.rand(20, 20, 20, generator=torch.Generator().manual_seed(0))
    source = Grid.centred(20, spacing=2.0)
    one, other = (
        resample(values, source, turned(Grid.centred(12, spacing=mm), (0, 0, 10)))
        for mm in (3.0, 3.0 * (1 + nudge))
    )
    torch.testing.assert_close(one, other)


@pytest.mark.parametrize("factors", [(1, 1, 1), (2, 2, 2), (3, 1, 2)])
def test_a_linear_field_is_resampled_exactly_to_whole_blocks(factors):
    target = pooled(
        plane(SOURCE)[:24, :36, :42], SOURCE.cropped(Box((0, 0, 0), (24, 36, 42))), factors
    )[1]
    assert torch.allclose(resample(plane(SOURCE), SOURCE, target), plane(target), atol=2e-5)


def cut(volume, source, target):
    """Closed form, voxel by voxel: the lengths that a voxel of each grid have in common, along x, y
    and z.
    """
    means = volume.double()
    for axis, k in enumerate((2, 1, 0)):
        edges = []
        for grid in (source, target):
            first = grid.affine[k, 3].item() - grid.spacing[k] / 2
            edges.append([first + grid.spacing[k] * n for n in range(grid.shape[axis] + 1)])
        (s, t), rows = edges, []
        for a, b in pairwise(t):
            rows.append([max(0.0, min(b, d) - max(a, c)) / (b - a) for c, d in pairwise(s)])
        means = torch.tensordot(
            torch.tensor(rows, dtype=torch.float64), means, dims=([1], [axis])
        ).movedim(0, axis)
    return means


@pytest.mark.pairwise(
    spacing=[(0.9, 1.3, 2.0), (2.0, 2.2, 3.0), (3.1, 4.5, 7.0), (15.0, 9.0, 11.0)], axis=[0, 1, 2]
)
def test_the_mean_over_each_voxel_is_exact_whatever_the_slabs(spacing, axis):
    volume = torch.rand(SOURCE.shape, generator=torch.Generator().manual_seed(3))
    target = Grid.centred(size=(7, 9, 11), spacing=spacing, centre=(8.0, -3.0, -20.0))
    down = [
        (k, volume.narrow(axis, k, min(7, SOURCE.shape[axis] - k)))
        for k in range(0, SOURCE.shape[axis], 7)
    ][::-1]
    means = resample(Slabs(SOURCE.shape, axis, lambda: iter(down)), SOURCE, target)
    assert torch.allclose(means.double(), cut(volume, SOURCE, target), atol=1e-6)


def test_the_means_over_finer_voxels_have_the_mean_of_the_coarse_one():
    volume = torch.rand(SOURCE.shape, generator=torch.Generator().manual_seed(4))
    target = Grid.centred(size=(5, 7, 6), spacing=9.3, centre=(2.0, 0.0, -3.0))
    coarse = resample(volume, SOURCE, target)
    for factor in (2, 3, 4):
        finer = resample(volume, SOURCE, target.refined(factor))
        assert torch.allclose(F.avg_pool3d(finer[None], factor)[0], coarse, atol=1e-6)


def test_a_grid_of_the_same_voxels_gets_the_same_values():
    volume = torch.rand(SOURCE.shape, generator=torch.Generator().manual_seed(5))
    assert torch.allclose(resample(volume, SOURCE, SOURCE), volume, atol=1e-7)


def test_a_turned_grid_needs_only_the_blocks_around_it():
    volume = torch.rand(SOURCE.shape, generator=torch.Generator().manual_seed(6))
    target = turned(Grid.centred((2, 2, 2), 9.0, centre=(9.0, -8.0, 11.0)), (20, -10, 30))
    whole, grid = pooled(volume, SOURCE, (3, 3, 2))
    assert pooled(volume, SOURCE, (3, 3, 2), target)[0].numel() < whole.numel() / 4
    assert torch.allclose(
        resample(volume, SOURCE, target), resample(whole, grid, target), atol=1e-6
    )


@pytest.mark.parametrize("spacing", [1.5, 4.0, 6.5])
def test_the_total_is_conserved(spacing):
    xyz = voxel_centres(SOURCE)
    ball = ((xyz - SOURCE.centre).norm(dim=-1) < 25).float()
    count = int(100 / spacing)
    target = Grid.centred((count,) * 3, spacing, centre=(4.0, 1.0, -3.0))
    total = resample(ball, SOURCE, target).sum() * spacing**3
    assert total.item() == pytest.approx((ball.sum() * 2.0 * 2.2 * 3.0).item(), rel=5e-3)


def test_fine_stripes_do_not_alias():
    stripes = torch.zeros(30, 40, 44)
    stripes[:, :, ::2] = 1.0
    coarse = resample(stripes, SOURCE, Grid.centred((4, 4, 4), 9.0, centre=(5.0, 0.0, -4.0)))
    assert (coarse - 0.5).abs().max() < 0.06


def test_values_outside_are_zero():
    far = Grid.centred((4, 4, 4), 3.0, centre=(400.0, 0.0, 0.0))
    assert not resample(torch.ones(30, 40, 44), SOURCE, far).any()


def test_results_do_not_depend_on_slabs(monkeypatch):
    target = Grid.centred(size=(12, 11, 10), spacing=5.0)
    whole = resample(plane(SOURCE), SOURCE, target)
    monkeypatch.setattr(module, "BLOCK_POINTS", 1)
    assert torch.equal(resample(plane(SOURCE), SOURCE, target), whole)


def test_pooling_keeps_the_total_and_the_positions():
    values, grid = pooled(plane(SOURCE), SOURCE, (2, 4, 3))
    assert values.shape == grid.shape == (10, 10, 22)
    assert torch.allclose(values, plane(grid), atol=1e-5)
    odd, _ = pooled(torch.ones(30, 40, 44), SOURCE, (5, 7, 4))
    assert odd.sum() * 5 * 7 * 4 == 30 * 40 * 44
