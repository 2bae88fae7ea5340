"""The transmission of frusta: the share of each bin's emission that reaches the detector."""

import pytest
import torch
from torch.nn.functional import avg_pool3d

from mvrecon.geometry.cameras.rigs import circular, dcspect80, parallel
from mvrecon.geometry.grid import Grid, voxel_centres
from mvrecon.methods.learned.cross_view import PerViewEstimates
from mvrecon.methods.learned.geometry import Geometry
from mvrecon.methods.learned.view_frames import LEAST, Frusta, ViewFrames, transmission
from mvrecon.methods.method import build_method
from mvrecon.operators.drr import Drr
from mvrecon.operators.operator import PerSample
from mvrecon_spect.operators.projector import Spect

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
    return ball_at(voxel_centres(GRID).double(), radius, at)[None, None]


def ball_at(places, radius, at=(0.0, 0.0, 0.0)):
    """Its values at places in mm."""
    return torch.sigmoid((radius - (places - places.new_tensor(at)).norm(dim=-1)) / 4.0)


def attenuated_integrals(cameras, emission, mu, step=0.5, reach=150.0):
    """Sums of small steps along every pixel's ray, within 150 mm of its point nearest to the
    origin, of functions of places; photons travel towards growing w.
    """
    start, end = cameras.rays()
    along = torch.nn.functional.normalize(end - start, dim=-1)
    nearest = start - (start * along).sum(dim=-1, keepdim=True) * along
    t = torch.arange(-reach, reach, step).to(start) + step / 2
    views = []
    for place, way in zip(nearest, along, strict=True):
        places = place[..., None, :] + t[:, None] * way[..., None, :]
        inside = mu(places) * step
        beyond = inside.flip(-1).cumsum(dim=-1).flip(-1) - inside / 2
        views.append((emission(places) * (-beyond).exp()).sum(dim=-1) * step)
    return torch.stack(views)[None, None]


@pytest.mark.parametrize("rig", RIGS)
def test_the_transmitted_density_of_a_frustum_sums_to_the_attenuated_view(rig):
    cameras, emission, mu = RIGS[rig](), ball(45.0, (20.0, -10.0, 5.0)), WATER * ball(80.0)
    frusta = Frusta.of(GRID, cameras, 64)
    frusta = frusta.to(torch.float64)
    density = frusta.to_frusta(emission[:, None]) * frusta.occupied
    views = attenuated_integrals(
        cameras,
        lambda places: ball_at(places, 45.0, (20.0, -10.0, 5.0)),
        lambda places: WATER * ball_at(places, 80.0),
    )
    seen = frusta.integrate(density * transmission(frusta, mu))
    assert (seen - views).norm() < 0.015 * views.norm()
    assert (frusta.integrate(density) - views).norm() > 0.5 * views.norm()


def test_only_an_attenuating_operator_has_a_transmission():
    cameras = RIGS["pinholes"]()
    clear = Spect(GRID, cameras, mu=torch.zeros(GRID.shape))
    assert clear.mu_map() is None and Drr(GRID, cameras).mu_map() is None
    A = 2.0 * Spect(GRID, cameras, mu=torch.full(GRID.shape, WATER))
    assert torch.equal(A.mu_map(), torch.full(GRID.shape, WATER))
    frames = [ViewFrames.of(Geometry.of(B), scale=1, binning=1, depths=8) for B in (clear, A)]
    assert frames[0].transmission is None
    assert LEAST <= frames[1].transmission.min() < 0.2 < frames[1].transmission.max() <= 1


@torch.no_grad()
def test_estimates_correct_a_faint_initial_volume_at_any_depth():
    """By each camera's estimate before training, as well through attenuating matter as without."""
    cameras = dcspect80(pixels=[16, 16], columns=[0, 7, 13], rows=[0, 2])
    truth = ball(25.0, (-40.0, 30.0, 0.0)).float()
    estimates = PerViewEstimates((4,), 0, 1, 32, 1, "softmax_depth")
    expected, errors = avg_pool3d(truth, 2)[:, None], []
    for density in (0.0, WATER):
        A = 2.0 * Spect(GRID, cameras, mu=density * ball(85.0)[0, 0].float())
        g, views, x = Geometry.of(A), A(truth), 0.7 * truth
        r = views - A(x)
        change, *_ = estimates(estimates.frames(g), g, views, r, x)
        error = avg_pool3d(x, 2)[:, None] + change - expected
        errors.append((error.norm() / expected.norm()).item() / 6**0.5)
    assert errors[1] < 1.2 * errors[0]


@torch.no_grad()
def test_each_sample_of_a_batch_is_reconstructed_with_its_own_attenuation():
    grid, cameras = Grid.centred(12, spacing=12.0), dcspect80(pixels=12, columns=[0, 7])
    body = torch.zeros(grid.shape)
    body[2:10, 2:10, 2:10] = WATER
    operators = [Spect(grid, cameras, mu=factor * body) for factor in (1.0, 0.5)]
    torch.manual_seed(0)
    method = build_method({"name": "cross_view", "widths": [4, 6], "depth_widths": [4], "scale": 1})
    for parameter in method.parameters():
        parameter += 0.1 * torch.randn_like(parameter)
    both, volume = PerSample(operators), torch.rand(2, 1, *grid.shape)
    views = both(volume)
    batch = method(views, both).volume
    for i, A in enumerate(operators):
        alone = method(views[i : i + 1], A).volume
        torch.testing.assert_close(batch[i : i + 1], alone, rtol=1e-4, atol=1e-5)
