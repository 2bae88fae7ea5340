"""The cameras' frames: cells of pixels, and the attenuation in a frustum."""

import math

import pytest
import torch
from torch.nn.functional import avg_pool3d

from mvrecon.cameras.dcspect80 import dcspect80
from mvrecon.cameras.rigs import circular, parallel
from mvrecon.geometry.grid import Grid, voxel_centres
from mvrecon.models.cross_view import PerViewEstimates
from mvrecon.models.frusta import Frusta
from mvrecon.models.geometry import Geometry
from mvrecon.models.view_frames import LEAST, ViewFrames, means, transmission
from mvrecon.parts import PROJECTORS
from mvrecon.projectors.attenuated import AttenuatedTransform
from mvrecon.projectors.drr import Drr
from tests.models.rig import small_projector, small_rig

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


def test_a_cell_beyond_the_detector_is_where_its_pixels_would_be():
    """So a cell is in the same place as that of a detector which the cells fill."""
    grid, cameras = small_rig(pixels=12)
    less = PROJECTORS.build("drr", grid=grid, cameras=cameras.cropped((0, 11), (0, 10)))
    whole = ViewFrames.of(Geometry.of(small_projector(pixels=12)), 0, 3, 8)
    frames = ViewFrames.of(Geometry.of(less), 0, 3, 8)
    assert torch.equal(frames.frusta.slant, whole.frusta.slant)
    views = torch.rand(1, 1, 4, 11, 10)
    expected = views[..., 9:11, 9:].mean(dim=(-2, -1))
    torch.testing.assert_close(means(views, 3)[..., -1, -1], expected)
    volume = torch.rand(1, 1, *grid.shape)
    whole, part = (f.project(f.to_frames(volume)) for f in (whole, frames))
    torch.testing.assert_close(part, whole)


def test_the_mean_along_a_ray_lies_between_the_weights_and_is_that_of_dense_voxels():
    A = small_projector()
    frames = ViewFrames.of(Geometry.of(A), 0, 3, 8)
    weights = torch.rand(1, 4, 1, 12, 12, 12)
    weights[..., 6:] = 2.0
    density = torch.zeros_like(weights) + 1e-3
    density[..., 8:] = 1.0
    views = torch.rand(1, 1, 4, 12, 12)
    means = frames.mean_along_rays(weights, density, views)
    assert means.shape == views.shape and 0 <= means.min() and means.max() <= 2 + 1e-5
    seen = frames.views(frames.project(frames.to_frames(density[:, 0])))
    thick = (seen > 4.0).repeat_interleave(3, dim=-1).repeat_interleave(3, dim=-2)
    assert thick.any() and means[thick].min() > 1.9


@pytest.mark.parametrize("rig", RIGS)
def test_the_transmitted_density_of_a_frustum_sums_to_the_attenuated_view(rig):
    cameras, emission, mu = RIGS[rig](), ball(45.0, (20.0, -10.0, 5.0)), WATER * ball(80.0)
    frusta = Frusta.of(GRID, cameras, 64)
    frusta = frusta.to(torch.float64)
    density = frusta.to_frusta(emission[:, None]) * frusta.occupied
    views = AttenuatedTransform(GRID, cameras, mu[0, 0])(emission)
    seen = frusta.integrate(density * transmission(frusta, mu))
    assert (seen - views).norm() < 0.015 * views.norm()
    assert (frusta.integrate(density) - views).norm() > 0.5 * views.norm()


def test_a_bin_has_the_transmission_that_its_depth_gives_it():
    """exp(-mu D) of the bins beyond it, and (1 - exp(-mu D)) / (mu D) of its own."""
    frusta = Frusta.of(GRID, RIGS["parallel"](), 32)
    share = transmission(frusta, WATER * torch.ones(1, 1, *GRID.shape))[0, 0, 0, :, 6, 6]
    size = WATER * 6.0
    expected = torch.exp(-size * torch.arange(31, -1, -1)) * -math.expm1(-size) / size
    torch.testing.assert_close(share[2:-2], expected[2:-2], rtol=0.06, atol=0)
    torch.testing.assert_close(share[3:-2] / share[2:-3], share.new_full((27,), math.exp(size)))


def test_attenuation_is_undone_and_nothing_is_divided_by_next_to_nothing():
    cameras = RIGS["cone"]()
    lead = AttenuatedTransform(GRID, cameras, torch.full(GRID.shape, 0.099))
    frames = ViewFrames.of(Geometry.of(lead), 0, 1, 8)
    assert frames.transmission.min() == LEAST
    density = torch.rand(1, 3, 1, *frames.frusta.shape)
    torch.testing.assert_close(frames.emitted(density) * frames.transmission, density)
    integrals = torch.rand(1, 1, 3, 12, 12) * (frames.frusta.chord[:, 0, 0] > 0)
    plain = ViewFrames.of(Geometry.of(Drr(GRID, cameras)), 0, 1, 8)
    for each in (frames, plain):
        even = each.spread(integrals)
        share = 1 if each.transmission is None else each.transmission
        torch.testing.assert_close(each.project(even * share), integrals)
    assert plain.emitted(density) is density


@torch.no_grad()
def test_a_start_that_is_too_faint_is_raised_by_its_lack_at_any_depth():
    """As well through attenuating matter as without it."""
    cameras = dcspect80(pixels=[16, 16], columns=[0, 7, 13], rows=[0, 2])
    truth = ball(25.0, (-40.0, 30.0, 0.0)).float()
    estimates = PerViewEstimates((4,), 0, 1, 32, 1, "softmax_depth")  # as before training
    expected, errors = avg_pool3d(truth, 2)[:, None], []
    for density in (0.0, WATER):
        A = 2.0 * AttenuatedTransform(GRID, cameras, density * ball(85.0)[0, 0].float())
        g, views, x = Geometry.of(A), A(truth), 0.7 * truth
        r = views - A(x)
        change, *_ = estimates(estimates.frames(g), g, views, r, x, g.direction(r))
        error = avg_pool3d(x, 2)[:, None] + change - expected
        errors.append((error.norm() / expected.norm()).item() / 6**0.5)
    assert errors[1] < 1.2 * errors[0]


def test_only_matter_that_attenuates_has_a_transmission():
    cameras = RIGS["pinholes"]()
    nothing = AttenuatedTransform(GRID, cameras, torch.zeros(GRID.shape))
    assert nothing.attenuation() is None and Drr(GRID, cameras).attenuation() is None
    A = 2.0 * AttenuatedTransform(GRID, cameras, torch.full(GRID.shape, WATER))
    assert torch.equal(A.attenuation(), A.A.mu)
    assert ViewFrames.of(Geometry.of(A), 1, 3, 4).transmission is not None
