"""Compared with the detector signal: the mean of closed-form integrals over each pixel."""

import pytest
import torch

from mvrecon.data.scenes.solids import Phantom, Solids, voxelise
from mvrecon.geometry.cameras.rigs import circular, dome
from mvrecon.geometry.grid import Grid
from mvrecon.geometry.rigid import random_rotation
from tests.operators.cases import METHODS, Case

N = 48
#: A pixel is as wide as a voxel where the rays pass the centre.
PIXELS = {"pixels": [N, N], "pixel_mm": 1.5}
RIGS = {
    "circular": circular(6, 3.0 * N, 4.5 * N, PIXELS, start_degrees=3.0),
    "oblique": dome(6, 3.0 * N, 4.5 * N, 150.0, PIXELS, extent="segment"),
}
GRID = Grid.centred((N, N, N), 1.0)


def ellipsoids(count: int = 7) -> Phantom:
    """In any pose, one large one around the others."""
    rng = torch.Generator().manual_seed(11)
    places = N * 0.18 * (2 * torch.rand(count, 3, generator=rng, dtype=torch.float64) - 1)
    axes = N * (0.05 + 0.12 * torch.rand(count, 3, generator=rng, dtype=torch.float64))
    places[0], axes[0] = 0, N * torch.tensor([0.42, 0.36, 0.4])
    values = 0.3 + torch.rand(count, generator=rng, dtype=torch.float64)
    return Phantom((Solids("ellipsoid", places, random_rotation(rng, count), axes, values),))


@pytest.fixture(scope="module", params=RIGS)
def errors(request) -> tuple[str, dict[str, float], dict[str, float]]:
    """Of each method with 1 and 4 rays per pixel, relative to the pixel averages and to the thin
    rays.
    """
    rig, solids = RIGS[request.param], ellipsoids()
    x = voxelise(solids, GRID)[None, None].double()
    fine = solids.integrals(*rig.refined(4).rays(), ray_extent=rig.ray_extent)
    pixel = fine.unflatten(2, (-1, 4)).unflatten(1, (-1, 4)).mean(dim=(2, 4))
    thin = solids.integrals(*rig.rays(), ray_extent=rig.ray_extent)
    of_pixel, of_thin = {}, {}
    for method in METHODS:
        for rays in (1, 4):
            views = Case(GRID, rig).build(method=method, rays_per_pixel=rays)(x)[0, 0]
            of_pixel[f"{method}{rays}"] = ((views - pixel).norm() / pixel.norm()).item()
            of_thin[f"{method}{rays}"] = ((views - thin).norm() / thin.norm()).item()
    return request.param, of_pixel, of_thin


def test_joseph_is_no_worse_than_siddon(errors):
    _, pixel, _ = errors
    assert pixel["joseph1"] < 1.03 * pixel["siddon1"], pixel


def test_joseph_is_better_than_trilinear(errors):
    """It blurs only across the ray, which is an advantage for oblique rays."""
    rig, pixel, _ = errors
    assert pixel["joseph1"] < {"oblique": 0.92, "circular": 0.96}[rig] * pixel["trilinear1"], pixel


def test_all_methods_are_close_to_the_truth(errors):
    assert all(0 < error < 0.03 for each in errors[1:] for error in each.values()), errors


def test_several_rays_per_pixel_bring_siddon_closer_to_the_pixel_mean(errors):
    _, pixel, thin = errors
    assert pixel["siddon4"] < 0.95 * pixel["siddon1"], pixel
    assert thin["joseph1"] < thin["joseph4"], thin
