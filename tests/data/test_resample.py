"""Resampling: exact for what is linear, and it neither makes nor loses attenuation."""

import pytest
import torch

from mvrecon.data import resample as module
from mvrecon.data.resample import pooled, resample
from mvrecon.geometry.grid import Grid, voxel_centres
from mvrecon.geometry.rigid import euler_rotation

SOURCE = Grid.centred(size=(44, 40, 30), spacing=(2.0, 2.2, 3.0), centre=(5.0, 0.0, -4.0))


def plane(grid):
    return (voxel_centres(grid) @ torch.tensor([0.3, -0.2, 0.1], dtype=torch.float64) + 7).float()


def turned(grid, degrees):
    affine = grid.affine.clone()
    rotation = euler_rotation(degrees, "xyz")
    affine[:3, :3] = rotation @ affine[:3, :3]
    affine[:3, 3] = rotation @ (affine[:3, 3] - grid.centre) + grid.centre
    return Grid(grid.shape, affine)


@pytest.mark.parametrize("spacing", [0.9, 2.0, 3.1, 4.5, 7.0])
@pytest.mark.parametrize("degrees", [(0, 0, 0), (20, -10, 30)])
def test_a_linear_field_is_resampled_exactly(spacing, degrees):
    count = int(36 / spacing)
    target = turned(Grid.centred((count,) * 3, spacing, centre=(3.0, 1.0, -2.0)), degrees)
    assert torch.allclose(resample(plane(SOURCE), SOURCE, target), plane(target), atol=2e-5)


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


def test_there_is_nothing_outside():
    far = Grid.centred((4, 4, 4), 3.0, centre=(400.0, 0.0, 0.0))
    assert not resample(torch.ones(30, 40, 44), SOURCE, far).any()


def test_slabs_change_nothing(monkeypatch):
    target = Grid.centred(size=(12, 11, 10), spacing=5.0)
    whole = resample(plane(SOURCE), SOURCE, target)
    monkeypatch.setattr(module, "POINTS", 1)
    assert torch.equal(resample(plane(SOURCE), SOURCE, target), whole)


def test_pooling_keeps_the_total_and_the_places():
    values, grid = pooled(plane(SOURCE), SOURCE, (2, 4, 3))
    assert values.shape == grid.shape == (10, 10, 22)
    assert torch.allclose(values, plane(grid), atol=1e-5)
    odd, _ = pooled(torch.ones(30, 40, 44), SOURCE, (5, 7, 4))
    assert odd.sum() * 5 * 7 * 4 == 30 * 40 * 44
