"""Methods that work on a support: which voxels change, and which do not."""

import pytest
import torch
from torch.nn.functional import max_pool3d

from mvrecon.geometry.grid import Box
from mvrecon.methods.learned import geometry
from mvrecon.operators.visual_hull import support as supports
from mvrecon.training.losses import ReconstructionLoss
from tests.methods.learned.rig import stirred

pytestmark = pytest.mark.filterwarnings("ignore:Rays are up to")
NAMES = ("cross_view", "world_unet")


@pytest.fixture(scope="module")
def scenes(projector):
    """Two objects in different corners of the middle, their views, and masks a voxel wider."""
    torch.manual_seed(1)
    volume = torch.zeros(2, 1, 24, 24, 24)
    volume[0, 0, 9:12, 7:11, 9:13] = 1 + torch.rand(3, 4, 4)
    volume[1, 0, 11:14, 12:15, 8:11] = 1 + torch.rand(3, 3, 3)
    return volume, projector(volume), max_pool3d((volume > 0).float(), 3, stride=1, padding=1) > 0


@pytest.fixture
def given(monkeypatch):
    """Makes a mask the support of all views."""

    def use(mask: torch.Tensor) -> None:
        monkeypatch.setattr(geometry, "support_masks", lambda *_: mask)

    return use


@pytest.mark.parametrize("name", NAMES)
@torch.no_grad()
def test_a_sample_on_its_support_does_not_depend_on_the_others(name, projector, scenes, given):
    _, views, mask = scenes
    method, single = stirred(name, support="hull"), []
    for i in range(2):
        given(mask[i : i + 1])
        single.append(method(views[i : i + 1], projector).volume)
    given(mask)
    out = method(views, projector)
    torch.testing.assert_close(out.volume, torch.cat(single), rtol=1e-5, atol=1e-5)
    assert torch.equal(out.support, mask) and not (out.volume * ~mask).any()


@pytest.mark.parametrize("kind", ["hull", "box", "auto"])
@torch.no_grad()
def test_the_support_of_measured_views_holds_the_object(kind, projector, scenes):
    volume, views, _ = scenes
    out = stirred("world_unet", support=kind)(views, projector)
    assert not (volume * ~out.support).any() and not out.support.all()
    if kind == "box":
        assert all(mask.sum() == Box.around(mask).size for mask in out.support)


@pytest.mark.parametrize("name", NAMES)
@torch.no_grad()
def test_zero_views_give_a_zero_volume(name, projector):
    out = stirred(name, support="hull")(torch.zeros(2, 1, 4, 36, 36), projector)
    assert out.volume.shape == (2, 1, 24, 24, 24) and not out.volume.any() and not out.support.any()


@pytest.mark.parametrize("name", NAMES)
@torch.no_grad()
def test_a_support_keeps_the_weights_and_a_full_support_changes_nothing(
    name, projector, scenes, given
):
    _, views, mask = scenes
    given(torch.ones_like(mask))
    off, on = stirred(name).double(), stirred(name, support="hull").double()
    on.load_state_dict(off.state_dict())
    volumes = [method(views.double(), projector).volume for method in (off, on)]
    torch.testing.assert_close(*volumes, rtol=1e-9, atol=1e-9)


def test_auto_uses_the_full_grid_if_the_hull_s_box_is_most_of_it(monkeypatch):
    hull = torch.zeros(1, 1, 10, 10, 10, dtype=torch.bool)
    hull[..., 1:7, :, 0] = hull[..., 1, :, 9] = True
    small = torch.zeros_like(hull)
    small[..., 2, 3:5, 7] = True

    def support_of(mask, kind):
        monkeypatch.setattr(supports, "hull_mask", lambda *_: mask)
        return supports.support_masks(mask, None, None, kind)

    assert torch.equal(support_of(hull, "auto"), hull)
    hull[..., 8, 5, 5] = True  # now its box holds 0.8 of the voxels
    assert support_of(hull, "auto").all() and torch.equal(support_of(hull, "hull"), hull)
    both = torch.cat([hull, small])  # each by itself
    assert support_of(both, "auto")[0].all()
    assert torch.equal(support_of(both, "auto")[1:], small)
    assert torch.equal(support_of(both, "box")[1:], small)
    assert support_of(both, "box")[0].sum() == 8 * 10 * 10
    assert not support_of(torch.zeros_like(hull), "box").any()


def test_losses_include_only_voxels_of_the_support(projector, scenes, given):
    volume, views, mask = scenes
    given(mask)
    with torch.no_grad():
        out = stirred("cross_view", support="hull", scale=0)(views, projector)
    loss = ReconstructionLoss(1.0, per_view_gain=0.1, cross_view=0.01)
    terms = loss(out, {"volume": volume, "views": views})
    error = (out.volume - volume)[mask]
    assert terms["volume"].item() == pytest.approx(error.square().mean().item(), rel=1e-4)
    outside = loss(out, {"volume": volume + 5.0 * ~mask, "views": views})
    for name in ("volume", "per_view_gain"):
        assert torch.equal(outside[name], terms[name]), name
