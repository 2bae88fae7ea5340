"""NEMA's spheres and Defrise's discs: volumes, contrast, places."""

import math

import pytest
import torch

from mvrecon.geometry.grid import Grid
from mvrecon.scenes.analytic import generator
from mvrecon.scenes.defrise import Defrise
from mvrecon.scenes.nema import CIRCLE, DIAMETERS, Nema
from mvrecon.scenes.voxelise import voxelise


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
    mu = scene.attenuation(0, 0, grid)
    assert mu.max().item() == pytest.approx(0.01536, rel=1e-6)
    body = math.pi * 100 * 90 * 120 * 0.01536
    assert mu.sum().item() * 64 == pytest.approx(body, rel=2e-3)


def test_discs_are_at_their_pitch_and_nothing_is_between_them():
    grid = Grid.centred(16, 8.0, centre=(0, 0, 9))
    phantom = Defrise(discs=3).phantom(generator(0, 0), grid)
    z = torch.arange(-40.0, 41.0, dtype=torch.float64) + 0.5
    along = torch.stack([59 + 0 * z, 0 * z, z + 9], dim=-1)
    inside = (z.abs() < 4) | ((z.abs() - 16).abs() < 4)
    assert torch.equal(phantom.values(along) > 0, inside)
    mass = 3 * math.pi * 60**2 * 8
    assert voxelise(phantom, grid).sum().item() * 8**3 == pytest.approx(mass, rel=1e-2)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Nema(contrast=1.0), "contrast above 1"),
        (lambda: Nema(body_mm=(70, 90, 60)), "in the body"),
        (lambda: Nema(circle_mm=20), "do not overlap"),
        (lambda: Defrise(thickness_mm=20), "a pitch of at least"),
        (lambda: Defrise(discs=0), "one disc or more"),
    ],
)
def test_sizes_that_make_no_sense_are_refused(make, message):
    with pytest.raises(ValueError, match=message):
        make()
