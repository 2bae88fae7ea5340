"""Opinions at a resolution of their own, and rays that count by the weight of their camera."""

import math

import pytest
import torch
from mvrecon.models.cross_view.model import CrossView
from mvrecon.models.cross_view.opinions import FASTER
from mvrecon.models.cross_view.step import Measured, State

from mvrecon.models.geometry import whole_geometry
from tests.models.cross_view.test_model import blob
from tests.models.cross_view.test_opinions import CHOICES
from tests.models.rig import small_projector


@torch.no_grad()
def test_rays_count_as_their_camera_and_equally_before_training():
    projector = small_projector()
    views, volume = projector(blob(projector)), blob(projector)
    torch.manual_seed(0)
    model = CrossView(projector, CHOICES["rays"])
    opinions, out = model.rounds[0].opinions, model(views)
    opinions.log_strength = None
    assert torch.allclose(model(views).volume, out.volume, rtol=1e-5, atol=1e-7)
    x, visible = opinions._cells(volume), opinions.inside.frusta.visible.float()
    visible[0] = 0
    weights = visible / visible.sum(dim=0).clamp_min(1)
    rays = opinions._ray_weights(x, weights[None])
    assert rays.shape == (1, 1, 4, 4, 4) and not rays[:, :, 0].any()
    assert rays[:, :, 1:].min() >= 1 - 1e-5 and rays.max() == pytest.approx(4 / 3)


@pytest.mark.parametrize("strength", [1.0, 3.0])
@torch.no_grad()
def test_a_view_whose_rays_count_nothing_changes_no_volume(monkeypatch, strength):
    """In a round before training, where networks change nothing; with a strength above one, too:
    no ray counts less than nothing."""
    projector = small_projector()
    (one,) = CrossView(projector, CHOICES["rays"]).rounds
    one.opinions.log_strength.fill_(math.log(strength) / FASTER)
    weights = torch.ones(1, 1, 4, 4, 4)
    weights[:, :, 1] = 0
    monkeypatch.setattr(one.opinions, "_ray_weights", lambda *_: weights)
    geometry, x = whole_geometry(projector), blob(projector)
    chord, views = 1 / geometry.row.clamp_min(1e-3), 1.1 * projector(x)
    state, other = State(x, torch.zeros_like(x)), views.clone()
    other[:, :, 1] *= 2
    expected = one(Measured(geometry, views, chord), state).volume
    assert torch.equal(one(Measured(geometry, other, chord), state).volume, expected)
    assert not torch.allclose(expected, x, rtol=1e-2)


@pytest.mark.filterwarnings("ignore:Rays are up to")
@torch.no_grad()
def test_a_crop_takes_the_opinions_of_its_own_voxels():
    """A network in the world that looks at opinions alone gives inside the box what it gives on
    the whole grid."""
    projector = small_projector(size=32, pixels=32)
    volume = torch.zeros(1, 1, 32, 32, 32)
    volume[:, :, 20:24, 13:17, 12:18] = 1.0
    torch.manual_seed(2)
    model = CrossView(projector, CHOICES["coarse"], support="hull", crop=True).eval()
    world, entry = model.rounds[0].world, model.rounds[0].entry.weight
    for parameter in model.parameters():
        parameter += 0.1 * torch.randn_like(parameter)
    for block in (*world.down, *world.up):
        block.second.weight.zero_()
    world.first.weight.zero_()
    entry.normal_(std=10.0)
    views, shapes = projector(volume), []
    world.register_forward_hook(lambda net, args, out: shapes.append(out.shape[2:].numel()))
    cropped, model.crop = model(views).volume, False
    whole = model(views).volume
    assert shapes[0] < shapes[1] == 32**3
    assert (cropped - whole).abs().max() < 1e-5 * whole.abs().max()
    entry.zero_()
    assert (model(views).volume - whole).abs().max() > 1e-2 * whole.abs().max()
