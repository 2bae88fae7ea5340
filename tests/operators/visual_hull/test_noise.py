"""Empty bricks from noisy X-rays."""

import math

import pytest
import torch
from torch.nn.functional import max_pool3d

from mvrecon.data.scenes.solids import Phantom, Solids, voxelise
from mvrecon.geometry.cameras.camera import Cameras
from mvrecon.geometry.cameras.rigs import circular
from mvrecon.geometry.grid import Grid
from mvrecon.operators.visual_hull.hull import visual_hull
from mvrecon.operators.visual_hull.support import NOISE_WITNESSES, noise_threshold
from tests.operators.visual_hull.cases import World


def noisy_hull(views: torch.Tensor, rig: Cameras, grid: Grid, photons: float) -> torch.Tensor:
    return visual_hull(views, rig, grid, 2, noise_threshold(views, photons), NOISE_WITNESSES)


def test_a_body_in_air_is_found_completely_in_noisy_x_rays():
    """Ten draws at 1e5 photons. A hull that takes the noise for matter finds no air at all."""
    grid = Grid.centred((32, 32, 32), 4.0)
    rig = circular(16, 500.0, 800.0, {"pixels": [64, 64], "pixel_mm": 4.0})
    axes = torch.tensor([[40.0, 30.0, 45.0], [8.0, 8.0, 8.0]])
    centres, turns = (
        torch.tensor([[5.0, -4.0, 0.0], [10.0, 0.0, 5.0]]),
        torch.eye(3).expand(2, 3, 3),
    )
    body = Phantom((Solids("ellipsoid", centres, turns, axes, torch.tensor([0.02, 0.02])),))
    world, rng = World(grid, rig, body), torch.Generator().manual_seed(3)
    p = world.views.expand(10, -1, -1, -1, -1)
    noisy = -(torch.poisson(1e5 * (-p).exp(), generator=rng) / 1e5).log()
    truth = max_pool3d((voxelise(body, grid, 4) > 0).float()[None, None], 2)[:, 0] > 0
    stays, exact = noisy_hull(noisy, rig, grid, 1e5), visual_hull(p[:1], rig, grid, 2)
    assert not (truth & ~stays).any()
    assert stays.float().mean() < 1.3 * exact.float().mean() < 0.4
    assert visual_hull(noisy, rig, grid, 2).float().mean() > 0.9
    with pytest.raises(ValueError, match="positive photons and sigmas"):
        noise_threshold(noisy, 0.0)


def test_a_ray_without_photons_is_not_treated_as_empty():
    """Beyond p = 14 at 1e5 photons, 4 exp(p / 2) / sqrt(photons) is above p itself."""
    p = torch.tensor([0.01, 0.02, 5.0, 13.0, 15.0, 40.0, 200.0])
    assert (p > noise_threshold(p, 1e5)).tolist() == [False, True, True, True, True, True, True]
    assert noise_threshold(p, 1e5).max() == pytest.approx(2)


def test_detection_of_a_brick_requires_more_contrast_behind_more_matter():
    """The threshold is 4 exp(p / 2) / sqrt(photons): what is empty at few photons is not at
    many.
    """
    grid = Grid.centred((8, 8, 8), 1.0)
    rig = circular(5, 60.0, 90.0, {"pixels": [40, 40], "pixel_mm": 1.0})
    flat = torch.full((1, 1, 5, 40, 40), 0.5, dtype=torch.float64)
    limit = (4 * math.exp(0.25) / 0.5) ** 2
    assert noisy_hull(flat, rig, grid, 1.01 * limit).all()
    assert not noisy_hull(flat, rig, grid, 0.99 * limit).any()
