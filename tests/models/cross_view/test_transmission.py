"""What attenuates on the way to a detector, as opinions know it."""

import math

import pytest
import torch

from mvrecon.cameras.dcspect80 import dcspect80
from mvrecon.cameras.rigs import circular, parallel
from mvrecon.geometry.grid import Grid, voxel_centres
from mvrecon.models.cross_view.model import CrossView
from mvrecon.models.cross_view.opinions import Opinions
from mvrecon.models.cross_view.settings import OpinionOptions
from mvrecon.models.cross_view.transmission import LEAST, Transmission, transmissions
from mvrecon.models.frusta import Frusta
from mvrecon_spect.attenuated import AttenuatedTransform
from mvrecon.projectors.drr import Drr

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
    seen = frusta.integrate(density * transmissions(frusta, mu))
    assert (seen - views).norm() < 0.015 * views.norm()
    assert (frusta.integrate(density) - views).norm() > 0.5 * views.norm()


def test_a_density_has_the_transmission_that_its_depth_gives_it():
    frusta = Frusta.of(GRID, RIGS["parallel"](), 32)
    share = transmissions(frusta, WATER * torch.ones(1, 1, *GRID.shape))[0, 0, 0, :, 6, 6]
    size = WATER * 6.0
    expected = torch.exp(-size * torch.arange(31, -1, -1)) * -math.expm1(-size) / size
    torch.testing.assert_close(share[2:-2], expected[2:-2], rtol=0.06, atol=0)
    torch.testing.assert_close(share[3:-2] / share[2:-3], share.new_full((27,), math.exp(size)))


def test_attenuation_and_restoring_undo_each_other_and_nothing_is_divided_by_next_to_nothing():
    frusta = Frusta.of(GRID, RIGS["cone"](), 8)
    density = torch.rand(1, 3, 1, *frusta.shape)
    lead = Transmission(frusta, torch.full((1, 1, *GRID.shape), 0.1))
    assert lead.share.min() == LEAST
    torch.testing.assert_close(lead.restore(lead.attenuate(density)), density)
    views = torch.rand(1, 1, 3, 12, 12) * (frusta.chord[:, 0, 0] > 0)
    for transmission in (lead, Transmission(frusta, None)):
        even = transmission.spread(frusta, views)
        torch.testing.assert_close(frusta.integrate(transmission.attenuate(even)), views)
    assert Transmission(frusta, None).attenuate(density) is density


def opinions_of(A, x, truth):
    """The opinions before training from a volume, with the views of another one."""
    options = OpinionOptions(fusion="mean", features=0)
    opinions = Opinions(A, options, edge=2, binning=1, depths=32)
    projected = A(x)
    with torch.no_grad():
        own = torch.zeros(1, len(A.cameras), 1, *opinions.inside.frusta.shape)
        sums = A(torch.ones_like(x))
        return opinions(x, A(truth) - projected, projected, own, None, sums).opinions


def test_a_start_that_is_too_faint_is_raised_by_what_it_lacks_at_any_depth():
    cameras = dcspect80(pixels=[16, 16], columns=[0, 7, 13], rows=[0, 2])
    truth = ball(25.0, (-40.0, 30.0, 0.0)).float()
    errors = []
    for mu in (None, WATER * ball(85.0)[0, 0].float()):
        A = Drr(GRID, cameras) if mu is None else AttenuatedTransform(GRID, cameras, mu)
        opinions = opinions_of(A, 0.7 * truth, truth)
        expected = torch.nn.functional.avg_pool3d(truth, 2)[:, None]
        errors.append(((opinions - expected).norm() / expected.norm()).item() / 6**0.5)
    assert errors[1] < 1.2 * errors[0]


def test_only_what_attenuates_has_a_transmission():
    cameras = RIGS["pinholes"]()
    nothing = AttenuatedTransform(GRID, cameras, torch.zeros(GRID.shape))
    assert nothing.attenuation() is None and Drr(GRID, cameras).attenuation() is None
    A = 2.0 * AttenuatedTransform(GRID, cameras, torch.full(GRID.shape, WATER))
    assert torch.equal(A.attenuation(), A.A.mu)
    rounds = [
        {
            "resolution": "half",
            "widths": [4],
            "cameras": {"name": "rays2d", "widths": [4, 4], "depths": 4},
            "opinions": {},
        }
    ]
    model = CrossView(A, rounds)
    transmission = model.rounds[0].opinions.transmission
    assert transmission.share is not None
    assert not any("transmission" in name for name in model.state_dict())
