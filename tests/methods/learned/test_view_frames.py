"""The cameras' frames: cells of pixels, and the attenuation in a frustum."""

import math

import torch

from mvrecon.core.parts import PROJECTORS
from mvrecon.geometry.cameras.rigs import parallel
from mvrecon.geometry.grid import Grid
from mvrecon.methods.learned.geometry import Geometry
from mvrecon.methods.learned.view_frames import LEAST, Frusta, ViewFrames, means, transmission
from mvrecon.operators.operator import PerSample, Wrapped
from tests.methods.learned.rig import blob, small_projector, small_rig


class Attenuating(Wrapped):
    """An operator with an attenuation map, in 1/mm; what it computes does not matter here."""

    def __init__(self, A, mu):
        super().__init__(A)
        self.register_buffer("mu", mu)

    def forward(self, x):
        return self.A(x)

    def adjoint(self, y):
        return self.A.adjoint(y)

    def mu_map(self):
        return self.mu


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


def test_a_bin_has_the_transmission_of_its_depth():
    """exp(-mu D) of the bins beyond it, and (1 - exp(-mu D)) / (mu D) of its own; of the last bins
    at least `LEAST`.
    """
    grid = Grid.centred(32, spacing=6.0)
    detector = {"pixels": [12, 12], "pixel_mm": [14.0, 14.0]}
    frusta = Frusta.of(grid, parallel(3, detector=detector), 32)
    mu = 0.01536
    share = transmission(frusta, torch.full((1, 1, *grid.shape), mu))[0, 0, 0, :, 6, 6]
    size = mu * 6.0
    expected = torch.exp(-size * torch.arange(31, -1, -1)) * -math.expm1(-size) / size
    torch.testing.assert_close(share[2:-2], expected[2:-2], rtol=0.06, atol=0)
    torch.testing.assert_close(share[3:-2] / share[2:-3], share.new_full((27,), math.exp(size)))
    assert transmission(frusta, torch.full((1, 1, *grid.shape), 0.2)).min() == LEAST


def test_attenuation_is_corrected_without_division_by_tiny_values():
    A = small_projector()
    lead = Attenuating(A, torch.full((12, 12, 12), 0.5))
    frames = ViewFrames.of(Geometry.of(lead), 0, 1, 8)
    assert frames.transmission.min() == LEAST
    density = torch.rand(1, 4, 1, *frames.frusta.shape)
    torch.testing.assert_close(frames.emitted(density) * frames.transmission, density)
    integrals = torch.rand(1, 1, 4, 12, 12) * (frames.frusta.chord[:, 0, 0] > 0)
    plain = ViewFrames.of(Geometry.of(A), 0, 1, 8)
    for each in (frames, plain):
        even = each.spread(integrals)
        share = 1 if each.transmission is None else each.transmission
        torch.testing.assert_close(each.project(even * share), integrals)
    assert plain.emitted(density) is density


def test_a_sample_without_attenuation_leaves_that_of_the_others():
    """In any order: a patient's volume does not depend on the batch. Tried with `Spect(mu="case")`
    and maps of zeros, by cross_view and mean_fusion: 0.07 and 0.7 % of the volume.
    """
    A = small_projector()
    B = Attenuating(A, 0.03 * blob(A)[0, 0])
    alone = ViewFrames.of(Geometry.of(B), 1, 3, 8).transmission
    for each in ([A, B], [B, A]):
        both = ViewFrames.of(Geometry.of(PerSample(each)), 1, 3, 8).transmission
        expected = [alone if one is B else torch.ones_like(alone) for one in each]
        torch.testing.assert_close(both, torch.cat(expected))
    assert PerSample([A, A]).mu_map() is None


def test_the_transmission_uses_the_operator_of_each_sample():
    A, mu = small_projector(), 0.03 * blob(small_projector())[0, 0]
    each = [Attenuating(A, factor * mu) for factor in (1.0, 2.0)]
    both = ViewFrames.of(Geometry.of(PerSample(each)), 1, 3, 8).transmission
    alone = [ViewFrames.of(Geometry.of(B), 1, 3, 8).transmission for B in each]
    torch.testing.assert_close(both, torch.cat(alone))
    assert both[1].min() < both[0].min() < 0.9
    assert ViewFrames.of(Geometry.of(A), 1, 3, 8).transmission is None
