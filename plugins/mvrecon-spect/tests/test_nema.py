"""NEMA's spheres: volumes, contrast, places."""

import math

import pytest
import torch

from mvrecon.core.numbers import generator
from mvrecon.data.scenes.solids import voxelise
from mvrecon.geometry.grid import Grid
from mvrecon_spect.scenes.nema import CIRCLE, DIAMETERS, Nema


def test_spheres_have_their_volumes_and_the_contrast_to_the_body():
    grid = Grid.centred(size=(54, 50, 34), spacing=4.0, centre=(7, -5, 3))
    scene = Nema(value=8.0)
    phantom = scene.phantom(generator(0, 0), grid)
    angles = 2 * math.pi * torch.arange(6, dtype=torch.float64) / 6
    ring = CIRCLE * torch.stack([angles.cos(), angles.sin(), 0 * angles], dim=-1)
    assert phantom.values(ring + grid.centre).tolist() == pytest.approx([8.0] * 6)
    assert phantom.values(grid.centre[None]).item() == pytest.approx(2.0)
    spheres = sum(math.pi / 6 * d**3 for d in DIAMETERS)
    total = 2 * math.pi * 100 * 90 * 120 + 6 * spheres
    assert voxelise(phantom, grid).sum().item() * 64 == pytest.approx(total, rel=2e-3)
    mu = scene.maps(0, 0, grid)["mu"]
    assert mu.max().item() == pytest.approx(0.01536, rel=1e-6)
    body = math.pi * 100 * 90 * 120 * 0.01536
    assert mu.sum().item() * 64 == pytest.approx(body, rel=2e-3)


@pytest.mark.parametrize("diameters", [(20.0,), (20.0, 30.0)])
def test_a_body_may_have_fewer_spheres(diameters):
    grid = Grid.centred(size=(54, 50, 34), spacing=4.0)
    phantom = Nema(value=8.0, diameters=diameters).phantom(generator(0, 0), grid)
    spheres = sum(math.pi / 6 * d**3 for d in diameters)
    total = 2 * math.pi * 100 * 90 * 120 + 6 * spheres
    assert voxelise(phantom, grid).sum().item() * 64 == pytest.approx(total, rel=2e-3)
    assert phantom.values(torch.tensor([[CIRCLE, 0.0, 0.0]])).item() == pytest.approx(8.0)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Nema(contrast=1.0), "contrast above 1"),
        (lambda: Nema(body_mm=(70, 90, 60)), "in the body"),
        (lambda: Nema(circle_mm=20), "do not overlap"),
    ],
)
def test_invalid_sizes_are_refused(make, message):
    with pytest.raises(ValueError, match=message):
        make()
