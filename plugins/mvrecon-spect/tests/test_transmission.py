"""The transmission of frusta: the share of each bin's emission that reaches the detector."""

import math

import pytest
import torch

from mvrecon.cameras.dcspect80 import dcspect80
from mvrecon.cameras.rigs import circular, parallel
from mvrecon.geometry.grid import Grid, voxel_centres
from mvrecon.models.frusta import Frusta
from mvrecon.models.geometry import Geometry
from mvrecon.models.view_frames import LEAST, ViewFrames, transmission
from mvrecon.projectors.drr import Drr
from mvrecon_spect.attenuated import AttenuatedTransform

WATER = 0.01536
GRID = Grid.centred(32, spacing=6.0)
DETECTOR = {"pixels": [12, 12], "pixel_mm": [24.0, 24.0]}
RIGS = {
    "pinholes": lambda: dcspect80(pixels=[12, 12], columns=[0, 7, 13], rows=[0, 2]),
    "cone": lambda: circular(3, sid=400.0, sdd=600.0, detector=DETECTOR),
    "parallel": lambda: parallel(3, detector={"pixels": [12, 12], "pixel_mm": [14.0, 14.0]}),
}


def ball(radius, at=(0.0, 0.0, 0.0)):
    """A smooth ball of 1 on the grid, at a place (x, y, z) in mm."""
    far = (voxel_centres(GRID).double() - torch.tensor(at)).norm(dim=-1)
    return torch.sigmoid((radius - far) / 4.0)[None, None]


@pytest.mark.parametrize("rig", RIGS)
def test_what_reaches_the_detector_in_a_frustum_is_the_camera_s_own_view(rig):
    cameras, emission, mu = RIGS[rig](), ball(45.0, (20.0, -10.0, 5.0)), WATER * ball(80.0)
    frusta = Frusta.of(GRID, cameras, 64)
    frusta = frusta.to(torch.float64)
    density = frusta.to_frusta(emission[:, None]) * frusta.occupied
    views = AttenuatedTransform(GRID, cameras, mu[0, 0])(emission)
    seen = frusta.integrate(density * transmission(frusta, mu))
    assert (seen - views).norm() < 0.015 * views.norm()
    assert (frusta.integrate(density) - views).norm() > 0.5 * views.norm()


def test_a_density_has_the_transmission_that_its_depth_gives_it():
    frusta = Frusta.of(GRID, RIGS["parallel"](), 32)
    share = transmission(frusta, WATER * torch.ones(1, 1, *GRID.shape))[0, 0, 0, :, 6, 6]
    size = WATER * 6.0
    expected = torch.exp(-size * torch.arange(31, -1, -1)) * -math.expm1(-size) / size
    torch.testing.assert_close(share[2:-2], expected[2:-2], rtol=0.06, atol=0)
    torch.testing.assert_close(share[3:-2] / share[2:-3], share.new_full((27,), math.exp(size)))


def test_no_bin_transmits_less_than_the_least():
    frusta = Frusta.of(GRID, RIGS["cone"](), 8)
    assert transmission(frusta, torch.full((1, 1, *GRID.shape), 0.1)).min() == LEAST


def test_only_an_operator_that_attenuates_has_a_transmission():
    cameras = RIGS["pinholes"]()
    clear = AttenuatedTransform(GRID, cameras, torch.zeros(GRID.shape))
    assert clear.attenuation() is None and Drr(GRID, cameras).attenuation() is None
    A = 2.0 * AttenuatedTransform(GRID, cameras, torch.full(GRID.shape, WATER))
    assert torch.equal(A.attenuation(), A.A.mu)
    frames = [ViewFrames.of(Geometry.of(B), scale=1, binning=1, depths=8) for B in (clear, A)]
    assert frames[0].transmission is None
    assert LEAST <= frames[1].transmission.min() < 0.2 < frames[1].transmission.max() <= 1
