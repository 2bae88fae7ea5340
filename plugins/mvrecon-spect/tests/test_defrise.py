"""Defrise's discs: places and mass."""

import math

import pytest
import torch

from mvrecon.core.numbers import generator
from mvrecon.data.scenes.solids import voxelise
from mvrecon.geometry.grid import Grid
from mvrecon_spect.scenes.defrise import Defrise


def test_discs_have_their_pitch_and_empty_gaps():
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
        (lambda: Defrise(thickness_mm=20), "a pitch of at least"),
        (lambda: Defrise(discs=0), "one disc or more"),
    ],
)
def test_invalid_sizes_are_refused(make, message):
    with pytest.raises(ValueError, match=message):
        make()
