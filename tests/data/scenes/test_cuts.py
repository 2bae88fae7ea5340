"""Solids cut by planes: chords, values, voxels and motions are those of the part that is left."""

import math

import pytest
import torch

from mvrecon.data.scenes.solids import ROUND_AXES, Phantom, Solids, voxelise
from mvrecon.geometry.grid import Grid
from mvrecon.geometry.rigid import random_rotation


def points(*places):
    return torch.tensor(places, dtype=torch.float64)


def cut(kind, cuts, axes=(20, 24, 30), n=1):
    turns, sizes = torch.eye(3).expand(n, 3, 3), points(axes).expand(n, 3)
    planes = points(*cuts).expand(n, -1, 4)
    return Solids(kind, torch.zeros(n, 3), turns, sizes, torch.ones(n), planes)


def test_half_an_ellipsoid_has_half_its_chords_and_half_its_volume():
    half = Phantom((cut("ellipsoid", [(0, 0, -1, 0)]),))  # z of at least 0
    ends = points((0, 0, 90), (90, 0, 0), (0, 90, 3))
    assert half.integrals(-ends[:1], ends[:1]).item() == pytest.approx(30)
    assert half.integrals(ends[:1], -ends[:1]).item() == pytest.approx(30)
    grazing = points((90, 0, -0.1)), points((-90, 0, -0.1))
    assert half.integrals(*grazing).item() == 0
    above = points((90, 0, 0.1)), points((-90, 0, 0.1))
    assert half.integrals(*above).item() == pytest.approx(40, rel=1e-4)
    volume = voxelise(half, Grid.centred((32, 32, 32), 2.0)).sum().item() * 8
    assert volume == pytest.approx(2 / 3 * math.pi * 20 * 24 * 30, rel=5e-3)


@pytest.mark.parametrize("kind", ROUND_AXES)
def test_chords_of_a_rotated_wedge_are_sums_of_its_values_along_the_ray(kind):
    rng = torch.Generator().manual_seed(3)
    wedge = cut(kind, [(0.6, -0.8, 0, 2), (0, 1, 0.5, 6), (0, 0, -1, 9)])
    phantom = Phantom((wedge.moved(random_rotation(rng), points((5, -3, 2))[0]),))
    ends = torch.randn(2, 40, 3, generator=rng, dtype=torch.float64) * 40
    t = (torch.arange(4000, dtype=torch.float64) + 0.5) / 4000
    along = ends[0][:, None] + t[:, None] * (ends[1] - ends[0])[:, None]
    length = (ends[1] - ends[0]).norm(dim=-1)
    sums = phantom.values(along).mean(dim=1) * length
    exact = phantom.integrals(*ends)
    assert exact.max() > 10
    assert (exact - sums).abs().max() <= 2 * length.max() / 4000


def test_voxels_of_a_cut_solid_are_means_of_its_values():
    grid = Grid.centred(size=(9, 8, 7), spacing=7.0, centre=(3, 1, -2))
    phantom = Phantom((cut("cylinder", [(0.6, -0.8, 0, 2), (0, 0.8, 0.6, 5)]),))
    fine = grid.refined(4)
    index = torch.cartesian_prod(*[torch.arange(n, dtype=torch.float64) for n in fine.shape])
    values = phantom.values(fine.to_world(index.flip(-1))).reshape(1, 1, *fine.shape)
    means = torch.nn.functional.avg_pool3d(values, 4)[0, 0].float()
    assert torch.allclose(voxelise(phantom, grid, 4), means, atol=1e-6)


def test_a_wrong_number_of_planes_is_refused():
    with pytest.raises(ValueError, match=r"finite cuts of shape \(2, 1, 4\)"):
        Solids("box", torch.zeros(2, 3), torch.eye(3).expand(2, 3, 3), torch.ones(2, 3),
               torch.ones(2), torch.zeros(1, 1, 4))  # fmt: skip
