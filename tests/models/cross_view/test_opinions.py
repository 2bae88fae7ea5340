"""Opinions within a round: what is exact, and what depends on what."""

import inspect
from dataclasses import replace

import pytest
import torch
import yaml
from mvrecon.models.cross_view.evidence import Evidence
from mvrecon.models.cross_view.model import CrossView
from mvrecon.models.cross_view.rays2d import Rays2d
from mvrecon.models.cross_view.settings import ROUNDS, RoundOptions
from mvrecon.models.cross_view.views import means
from torch.utils._python_dispatch import TorchDispatchMode

from mvrecon.config import conf_dir
from mvrecon.geometry.grid import Grid
from mvrecon.parts import CAMERAS, PROJECTORS
from mvrecon.testing import check_model
from tests.models.cross_view.test_model import blob
from tests.models.rig import small_projector, small_rig

WORLD = {"widths": [4], "resolution": "full"}
RAYS = {"name": "rays2d", "widths": [4, 6], "depths": 4}
FRUSTA = {"name": "frustum3d", "widths": [4, 6], "depths": 4}


def rounds(cameras=RAYS, **options) -> list:
    return [{"widths": [4, 6], "cameras": cameras, **options}, WORLD]


def alone(opinions: dict | None, cameras=RAYS) -> list:
    """One round at full resolution, whose network has voxels of a quarter of it, too."""
    widths = [4, 6, 8]
    return [{"resolution": "full", "widths": widths, "cameras": cameras, "opinions": opinions}]


CHOICES = {
    "weighted": rounds(opinions={"features": 2}),
    "mean": rounds(opinions={"fusion": "mean"}),
    "uniform": rounds(opinions={"prior": "uniform"}),
    "density": rounds(opinions={"head": {"name": "density"}}),
    "view": rounds(opinions={"places": "view"}),
    "full": rounds(opinions={}, resolution="full"),
    "quarter": rounds(opinions={}, resolution="quarter"),
    "placed alone": rounds({**RAYS, "correct": False}, opinions={}),
    "one each": rounds({**RAYS, "shared": False}, opinions={}),
    "frustum3d": rounds(FRUSTA),
    "frustum3d, one each": rounds({**FRUSTA, "shared": False}),
    "coarse": alone({"resolution": "quarter", "widths": [4]}),
    "rays": alone({"resolution": "half", "widths": [4], "weigh_rays": True}),
    "coarse, mean": alone({"resolution": "quarter", "fusion": "mean"}),
    "coarse, frustum3d": alone({"resolution": "half", "features": 0}, FRUSTA),
    "frustum3d, placed": rounds({**FRUSTA, "correct": False}, opinions={}),
}


def stirred(projector, choice="weighted") -> CrossView:
    """With random weights everywhere."""
    torch.manual_seed(2)
    model = CrossView(projector, CHOICES[choice]).eval()
    for parameter in model.parameters():
        parameter.data += 0.1 * torch.randn_like(parameter)
    return model


@pytest.mark.parametrize("choice", CHOICES)
def test_every_choice_of_cameras_keeps_the_contract(choice):
    check_model("cross_view", small_projector(), rounds=CHOICES[choice])


@pytest.mark.filterwarnings("ignore:Rays are up to")
def test_a_hull_of_odd_sizes_and_a_grid_of_one_slice_keep_the_contract():
    detector = {"pixels": [3, 15], "pixel_mm": 4.0}
    cameras = CAMERAS.build("circular", n_views=3, sid=100.0, sdd=200.0, detector=detector)
    grid = Grid.centred(size=(11, 9, 1), spacing=2.0)
    projector = PROJECTORS.build("drr", grid=grid, cameras=cameras)
    check_model("cross_view", projector, rounds=CHOICES["weighted"], support="hull")
    check_model("cross_view", projector, rounds=CHOICES["coarse"], support="hull")
    check_model("cross_view", projector, rounds=CHOICES["frustum3d"])


def test_the_preset_is_the_default():
    options = yaml.safe_load((conf_dir() / "model" / "cross_view.yaml").read_text())
    plain = inspect.signature(Rays2d).parameters
    for said, default in zip(options["rounds"], ROUNDS, strict=True):
        one, other = RoundOptions.of(said), RoundOptions.of(default)
        assert (one.resolution, tuple(one.widths)) == (other.resolution, tuple(other.widths))
        assert one.task == other.task
        for option in ("widths", "depths", "binning", "memory"):
            own = one.network[option]
            assert (tuple(own) if isinstance(own, list) else own) == plain[option].default
        own, usual = one.judged, other.judged
        assert (*own.widths,) == (*usual.widths,)
        assert replace(own, widths=usual.widths) == usual


def test_before_training_a_round_with_opinions_is_the_round_without():
    projector = small_projector()
    views = projector(blob(projector))
    torch.manual_seed(3)
    plain = CrossView(projector, rounds())
    for parameter in plain.parameters():
        parameter.data += 0.1 * torch.randn_like(parameter)
    model, n_inputs = CrossView(projector, CHOICES["mean"]), 32
    own, weights = plain.state_dict(), model.state_dict()
    for name, value in weights.items():
        if name == "rounds.0.world.first.weight":
            value[:, :n_inputs] = own[name]
            assert not value[:, n_inputs:].any() and value.shape[1] == n_inputs + 6
        elif "rounds.0.cameras.unet.last" in name:  # correction, depth, features, memory
            value[:9], value[-8:] = own[name][:9], own[name][9:]
        elif name in own:
            value.copy_(own[name])
    model.load_state_dict(weights)
    assert torch.allclose(model(views).volume, plain(views).volume, rtol=1e-5, atol=1e-7)


def test_before_training_opinions_at_a_coarser_scale_change_nothing():
    projector = small_projector()
    views = projector(blob(projector))
    model, plain = stirred(projector, "coarse"), CrossView(projector, alone(None))
    entry = model.rounds[0].entry.weight
    assert CrossView(projector, CHOICES["coarse"]).rounds[0].entry.weight.eq(0).all()
    before = model(views).volume
    torch.nn.init.zeros_(entry)
    own = model.state_dict()
    last = {name: own[name] for name in own if "rounds.0.cameras.unet.last" in name}
    last = {name: torch.cat([value[:9], value[-8:]]) for name, value in last.items()}
    weights = {name: own[name] for name in plain.state_dict()}
    plain.load_state_dict({**weights, **last})
    assert torch.allclose(model(views).volume, plain(views).volume, rtol=1e-5, atol=1e-7)
    assert not torch.allclose(before, plain(views).volume, rtol=1e-2)


def test_choices_at_their_defaults_change_no_bit_of_a_round_without_opinions():
    projector = small_projector()
    views = projector(blob(projector))
    said = rounds({**RAYS, "correct": True, "shared": True}, opinions=None)
    models = []
    for options in (rounds(), said):
        torch.manual_seed(0)
        models.append(CrossView(projector, options))
    assert list(models[0].state_dict()) == list(models[1].state_dict())
    assert not any("opinions" in name for name in models[0].state_dict())
    assert torch.equal(models[0](views).volume, models[1](views).volume)


@pytest.mark.parametrize("choice", ["weighted", "coarse"])
def test_in_its_frustum_every_camera_meets_its_own_view_whatever_the_network_says(choice):
    projector = small_projector()
    opinions = stirred(projector, choice).rounds[0].opinions
    frusta = opinions.inside.frusta
    measured = means(projector(blob(projector)), 3)
    placed = 3 * torch.randn(1, 4, 4, 4, 4, 4)
    prior = torch.rand(1, 4, 1, 4, 4, 4)
    density, _ = opinions._density(prior, measured, placed)
    rays = (frusta.chord > 0).transpose(0, 1).expand_as(measured[:, 0, :, None]).squeeze(2)
    met = frusta.integrate(density)[:, 0]
    assert rays.any() and torch.allclose(met[rays], measured[:, 0][rays], rtol=1e-5, atol=1e-5)


def test_counts_count_as_the_integrals_that_they_are_of():
    """Pixels of any sensitivity, but for chords in cells and in thin rays at the grid's edge."""
    projector = small_projector()
    opinions = stirred(projector).rounds[0].opinions
    volume = blob(projector)
    views, sums = projector(volume), projector(torch.ones_like(volume))
    placed = torch.randn(1, 4, 4, 4, 4, 4)
    projected = projector(0.9 * volume)
    residual = views - projected
    plain = opinions(0.9 * volume, residual, projected, placed, None)
    weight = 1e-4 * torch.linspace(0.9, 1.1, 4)[:, None, None]
    parts = weight * residual, weight * projected
    counts = opinions(0.9 * volume, *parts, placed, None, weight * sums)
    change = plain.opinions - 0.9 * opinions._cells(volume)[:, None]
    assert (counts.opinions - plain.opinions).norm() < 0.1 * change.norm()
    error = counts.expected / weight - plain.expected
    assert error.norm() < 0.1 * plain.expected.norm()


@torch.no_grad()
def test_before_training_cameras_that_miss_nothing_keep_the_volume_however_coarse_cells_are():
    """But for the floor of the head, of a hundredth of the density along a ray."""
    projector = small_projector()
    torch.manual_seed(2)
    opinions = CrossView(projector, CHOICES["coarse"]).rounds[0].opinions
    volume, placed = blob(projector) + 0.5, torch.zeros(1, 4, 2, 4, 4, 4)
    nothing = torch.zeros(1, 1, 4, 12, 12)
    parts = nothing, projector(volume)
    fused = opinions(volume, *parts, torch.cat([placed, placed], dim=2), None)
    x = opinions._cells(volume)[:, None].expand_as(fused.opinions)
    assert (fused.opinions - x).norm() < 0.01 * x.norm()


@pytest.mark.parametrize("choice", ["weighted", "coarse"])
def test_what_the_others_predict_of_a_view_does_not_depend_on_it(choice):
    projector = small_projector()
    opinions = stirred(projector, choice).rounds[0].opinions
    volume = blob(projector)
    projected = projector(volume)
    views = (1.1 * projected).requires_grad_()
    placed = torch.randn(1, 4, 4, 4, 4, 4)
    expected = opinions(volume, views - projected, projected, placed, None).expected
    for m in range(4):
        (gradient,) = torch.autograd.grad(expected[:, :, m].sum(), views, retain_graph=True)
        own, others = gradient[:, :, m].abs().max(), gradient.abs().max()
        assert own < 1e-5 * others


def test_in_a_frustum_the_others_are_all_but_the_camera_itself():
    projector = small_projector()
    network = stirred(projector, "frustum3d").rounds[0].cameras
    evidence = _evidence(projector, network)
    own = evidence.measured.requires_grad_()
    where = network.inside.frusta.occupied.float()
    others = network._volumes(evidence, where)[:, :, 4:8]
    (gradient,) = torch.autograd.grad(others[:, 1].sum(), own)
    assert gradient[:, :, 1].abs().max() < 1e-5 * gradient.abs().max()


def _evidence(projector, network):
    torch.manual_seed(4)
    views, x = torch.rand(1, 1, 4, 12, 12), blob(projector)
    return Evidence(views, 0.1 * views, x, 0.1 * x, torch.zeros(1, *network.memory_shape))


@torch.no_grad()
@pytest.mark.parametrize("choice", ["weighted", "rays", "frustum3d, placed"])
def test_weights_belong_to_their_camera_whatever_the_order(choice):
    grid, cameras = small_rig()
    order = torch.tensor([2, 0, 3, 1])
    turned = PROJECTORS.build("drr", grid=grid, cameras=cameras[order])
    projector = PROJECTORS.build("drr", grid=grid, cameras=cameras)
    views = projector(blob(projector))
    out, other = stirred(projector, choice)(views), stirred(turned, choice)(views[:, :, order])
    assert torch.allclose(out.volume, other.volume, atol=1e-5 * out.volume.abs().max())
    for name in ("opinions", "weights"):
        own, turned = getattr(out, name)[:, order], getattr(other, name)
        assert torch.allclose(own, turned, atol=1e-5 * own.abs().max()), name
    weighed = out.weights.sum(dim=1, keepdim=True)[out.visible.any(dim=0)[None, None]]
    assert torch.allclose(weighed, torch.ones(()), atol=1e-5)
    assert out.weights.std(dim=1).max() > 0.01


class Largest(TorchDispatchMode):
    """The number of elements of the largest tensor that any operation gives."""

    size = 0

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        out = func(*args, **(kwargs or {}))
        for tensor in out if isinstance(out, tuple | list) else [out]:
            if isinstance(tensor, torch.Tensor) and tensor.is_contiguous():
                self.size = max(self.size, tensor.untyped_storage().nbytes() // 4)
        return out


@torch.no_grad()
def test_no_operation_at_half_resolution_gives_a_volume_for_each_camera():
    projector = small_projector(n_views=16, size=16)
    model, views = stirred(projector), projector(blob(projector))
    with Largest() as largest:
        out = model(views)
    assert out.opinions is not None and out.opinions.shape == (1, 16, 1, 8, 8, 8)
    assert largest.size < 16 * 16**3
