"""The cross-view model: its contract with every option, its start, its symmetries, and each step's
exact properties.
"""

import copy
import io
import math
from dataclasses import replace

import pytest
import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d, avg_pool3d

from mvrecon.core.parts import CAMERAS, PROJECTORS
from mvrecon.geometry.grid import Grid
from mvrecon.methods.classical.sirt import (
    MIN_SENSITIVITY_SHARE,
    SirtWeights,
    inverse_sums,
    sirt,
    sirt_weights,
)
from mvrecon.methods.learned.cross_view import STRENGTH_RATE_FACTOR, CrossView
from mvrecon.methods.learned.geometry import Geometry
from mvrecon.methods.learned.start import reweighted
from mvrecon.methods.learned.view_frames import coarsened, leave_one_out
from mvrecon.operators.operator import Scaled
from mvrecon.operators.selection import view_subset
from mvrecon.testing import check_method
from tests.methods.learned.rig import SMALL, ball, blob, small, small_projector, small_rig, stirred

EM = {"steps": 1, "noise": "poisson", "rule": "em"}
OPTIONS = {
    "fusion": {"fusion": "mean"},
    "depth": {"depth": "uniform"},
    "prior": {"depth": "prior"},
    "no depth network": {"depth": "prior", "depth_widths": []},
    "shared": {"shared": False, "n_cameras": 4},
    "rays": {"weigh_rays": False},
    "no ray network": {"ray_widths": []},
    "head": {"head": "density"},
    "support": {"support": "hull"},
    "crop": {"support": "hull", "crop": True},
    "reweight": {"support": "hull", "reweight": 2},
    "full": {"scale": 0, "binning": 1, "features": 0},
    "counts": {"start": {"name": "osem", "iterations": 2, "subsets": 2}, "consistency": EM},
    "tv": {"start": {"name": "fista_tv", "iterations": 2, "weight": 1e-2}, "support": "box"},
}


#: Each of the options above, with others of other steps.
TOGETHER = [
    ("fusion", "head", "support"),
    ("depth", "shared", "crop"),
    ("prior", "no ray network", "reweight"),
    ("no depth network", "tv"),
    ("rays", "full"),
    ("counts",),
]


@pytest.mark.parametrize("options", TOGETHER, ids="-".join)
@pytest.mark.filterwarnings("ignore:Rays are up to")
def test_every_option_keeps_the_contract(options):
    assert {name for each in TOGETHER for name in each} == {*OPTIONS}
    given = {key: value for name in options for key, value in OPTIONS[name].items()}
    check_method("cross_view", small_projector(), **SMALL["cross_view"] | given)


@pytest.mark.filterwarnings("ignore:Rays are up to")
def test_a_grid_of_one_slice_and_a_detector_of_three_rows_keep_the_contract():
    detector = {"pixels": [3, 15], "pixel_mm": 4.0}
    cameras = CAMERAS.build("circular", n_views=3, sid=100.0, sdd=200.0, detector=detector)
    grid = Grid.centred(size=(11, 9, 1), spacing=2.0)
    A = PROJECTORS.build("drr", grid=grid, cameras=cameras)
    check_method("cross_view", A, **SMALL["cross_view"], support="hull")


@pytest.mark.parametrize("options", [{}, {"scale": 0, "binning": 1}, {"fusion": "mean"}], ids=str)
def test_before_training_it_is_sirt_with_data_consistency_steps(options):
    """Networks change nothing, every step has length one, and short chords count as a tenth of the
    longest.
    """
    A = small_projector()
    views = A(blob(A))
    row, column = sirt_weights(A)
    weights = SirtWeights(row.clamp_max(10 * row[row > 0].min()), column)
    expected = sirt(A, views, 3, momentum=True, weights=weights)
    expected = sirt(A, views, 3, nonnegative=False, start=expected, weights=weights)
    volume = small("cross_view", consistency=2, **options)(views, A).volume
    torch.testing.assert_close(volume, expected.clamp_min(0), rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("options", [{}, OPTIONS["shared"], OPTIONS["head"]], ids=str)
@torch.no_grad()
def test_the_order_of_the_cameras_does_not_matter(options):
    """Per-view quantities, and networks that are not shared, follow their cameras."""
    grid, cameras = small_rig()
    order = torch.tensor([2, 0, 3, 1])
    A = PROJECTORS.build("drr", grid=grid, cameras=cameras)
    permuted = PROJECTORS.build("drr", grid=grid, cameras=cameras[order])
    views, method = A(blob(A)), stirred("cross_view", **options)
    out = method(views, A)
    if "shared" in options:
        method = copy.deepcopy(method)
        for each in (method.estimates.image, method.estimates.unet):
            each.networks = torch.nn.ModuleList(each.networks[i] for i in order)
    other = method(views[:, :, order], permuted)
    torch.testing.assert_close(other.volume, out.volume, rtol=1e-4, atol=1e-5)
    for name in ("per_view", "weights"):
        own = getattr(out, name)[:, order]
        torch.testing.assert_close(getattr(other, name), own, rtol=1e-4, atol=1e-5)
    predicted = out.predictions[:, :, order]
    torch.testing.assert_close(other.predictions, predicted, rtol=1e-4, atol=1e-4)


@torch.no_grad()
def test_the_same_weights_support_any_rig_and_grid():
    """A call with one operator does not affect the next."""
    method = stirred("cross_view")
    for n_views, size, pixels in ((4, 12, 12), (8, 10, 11), (13, 9, 16), (1, 12, 12)):
        A = small_projector(n_views, size=size, pixels=pixels)
        views = A(blob(A))
        volume = method(views, A).volume
        assert volume.shape[2:] == A.grid.shape and volume.isfinite().all() and volume.any()
        assert torch.equal(stirred("cross_view")(views, A).volume, volume)
    assert not [name for name, _ in method.named_buffers()]


def test_per_camera_networks_require_their_number_of_cameras():
    counts = [
        sum(p.numel() for p in small("cross_view", **options).estimates.parameters())
        for options in ({}, OPTIONS["shared"])
    ]
    assert counts[1] == 4 * counts[0]
    A = small_projector(8)
    with pytest.raises(ValueError, match="Expected 4 cameras, got 8"):
        stirred("cross_view", **OPTIONS["shared"])(A(blob(A)), A)


@torch.no_grad()
def test_it_computes_in_float64():
    """As in float32, but for rounding."""
    A, method = small_projector(), stirred("cross_view")
    views = A(blob(A))
    single = method(views, A).volume
    double = method.double()(views.double(), A).volume
    assert double.dtype == torch.float64
    torch.testing.assert_close(double.float(), single, rtol=1e-4, atol=1e-4)


def test_weights_round_trip_through_a_file():
    A, method, other = small_projector(), stirred("cross_view"), small("cross_view")
    views, file = A(blob(A)), io.BytesIO()
    torch.save(method.state_dict(), file)
    file.seek(0)
    other.load_state_dict(torch.load(file))
    assert torch.equal(other(views, A).volume, method(views, A).volume)


def parts(method, A, volume, views, **geometry):
    """The arguments of a model's per-view estimates that start at a volume."""
    g = Geometry.of(A, volume.dtype, **geometry)
    r = views - A(volume)
    return method.estimates.frames(g), g, views, r, volume


@pytest.mark.parametrize("build", [small, stirred])
@torch.no_grad()
def test_each_density_reproduces_its_own_view_for_any_network_output(build):
    """By `softmax_depth`, in its camera's frustum: before training, and with random weights."""
    A, densities = small_projector(), []
    method, volume = build("cross_view"), blob(A)
    method.estimates.head.register_forward_hook(lambda _, given, out: densities.append(out))
    frames, g, views, r, *rest = parts(method, A, 0.8 * volume, A(volume))
    method.estimates(frames, g, views, r, *rest)
    prior = frames.project(frames.to_frames(coarsened(0.8 * volume, frames.scale)))
    expected = (prior + frames.integrals(r)) * (frames.frusta.chord[:, 0, 0] > 0)
    torch.testing.assert_close(frames.project(densities[0]), expected, rtol=1e-5, atol=1e-4)


@torch.no_grad()
def test_untrained_estimates_explain_their_views_better_than_the_initial_volume():
    """Also where no other camera confirms a view."""
    A, method = small_projector(size=24, pixels=24), small("cross_view", depths=24, binning=1)
    views = A(ball(24))
    views[:, :, 1] *= 1.2
    out = method(views, A)
    frames = method.estimates.frames(Geometry.of(A))
    start = frames.project(frames.to_frames(coarsened(out.start, frames.scale)))
    own = frames.project(frames.to_frames(out.per_view))
    measured = frames.integrals(views)
    before, after = ((p - measured)[0, 0].flatten(1).norm(dim=1) for p in (start, own))
    assert (after < 0.4 * before).all()


@torch.no_grad()
def test_untrained_estimates_equal_an_initial_volume_without_residual():
    """However coarse the cells, but for the floor of the head, a hundredth of the density along a
    ray.
    """
    A, method = small_projector(), small("cross_view")
    volume = blob(A) + 0.5
    change, *_ = method.estimates(*parts(method, A, volume, A(volume)))
    assert change.norm() < 0.01 * coarsened(volume, 1).expand_as(change[:, :, 0]).norm()


@torch.no_grad()
def test_counts_are_converted_to_their_integrals():
    """Pixels of any sensitivity, but for chords in cells and thin rays at the grid's edge."""
    A, method = small_projector(), stirred("cross_view")
    volume = blob(A)
    weights = 1e-4 * torch.linspace(0.9, 1.1, 4)[:, None, None]
    changes, integrals = [], []
    for B in (A, Scaled(A, pixels=weights)):
        frames, *rest = parts(method, B, 0.9 * volume, B(volume))
        change, *_ = method.estimates(frames, *rest)
        changes.append(change)
        integrals.append(frames.integrals(B(volume)))
    assert (changes[1] - changes[0]).norm() < 0.1 * changes[0].norm()
    assert (integrals[1] - integrals[0]).norm() < 0.1 * integrals[0].norm()


def test_the_prediction_of_a_view_depends_only_on_the_other_views(monkeypatch):
    """For a given volume and direction, which all views share."""
    own_direction = Geometry.direction
    monkeypatch.setattr(Geometry, "direction", lambda g, r: own_direction(g, r).detach())
    A, method = small_projector(), stirred("cross_view")
    volume = blob(A)
    views = (1.1 * A(volume)).requires_grad_()
    frames, *rest = parts(method, A, volume, views)
    change, *_ = method.estimates(frames, *rest)
    others, *_ = leave_one_out(change, frames.visible)
    predicted = frames.project(frames.to_frames(others))
    for m in range(4):
        (gradient,) = torch.autograd.grad(predicted[:, :, m].sum(), views, retain_graph=True)
        own, most = gradient[:, :, m].abs().max(), gradient.abs().max()
        assert own < 1e-5 * most


@torch.no_grad()
def test_predictions_are_projections_of_the_other_estimates_on_the_model_s_grid():
    """Accurate to some per cent for a smooth object: bins and cells are coarser than pixels."""
    A = small_projector(size=24, pixels=24)
    method = stirred("cross_view", scale=0, binning=1, depths=32)
    out = method(A(ball(24)), A)
    seen = out.visible.float().sum(dim=0) - out.visible.float()[1]
    others = out.per_view * out.visible
    mean = (others.sum(dim=1) - others[:, 1]) / seen.clamp_min(1)
    expected = A(mean)[:, :, 1]
    assert (out.predictions[:, :, 1] - expected).norm() < 0.1 * expected.norm()


@torch.no_grad()
def test_views_are_binned_to_the_cells_of_their_predictions():
    """Also where the detector is no multiple of a cell: the last cell of a row has fewer pixels."""
    A = small_projector(pixels=13)
    views = A(blob(A))
    out = stirred("cross_view", binning=5)(views, A)
    assert out.binned_views.shape == out.predictions.shape
    expected = avg_pool2d(views[:, 0], 5, ceil_mode=True)[:, None]
    torch.testing.assert_close(out.binned_views, expected)


@torch.no_grad()
def test_weights_sum_to_one_where_a_camera_sees_and_differ():
    A = small_projector()
    out = stirred("cross_view")(A(blob(A)), A)
    seen = out.visible.any(dim=0).expand(1, -1, -1, -1, -1)
    torch.testing.assert_close(out.weights.sum(dim=1), seen.float())
    assert out.weights.std(dim=1).max() > 0.01
    torch.testing.assert_close(out.camera_weights.sum(), torch.ones(()))


@torch.no_grad()
def test_rays_are_weighted_by_camera_and_equally_before_training():
    A, method = small_projector(), small("cross_view")
    views, volume = A(blob(A)), coarsened(blob(A), 1)
    frames = method.estimates.frames(Geometry.of(A))
    visible = frames.visible.float()
    equal = visible / visible.sum(dim=0).clamp_min(1)
    rays = method.ray_weights(frames, volume, equal[None], views)
    torch.testing.assert_close(rays, torch.ones_like(views))
    without = small("cross_view", weigh_rays=False)(views, A)
    assert torch.equal(method(views, A).volume, without.volume) and without.ray_weights is None
    visible[0] = 0
    weights = visible / visible.sum(dim=0).clamp_min(1)
    rays = method.ray_weights(frames, volume, weights[None], views)
    assert not rays[:, :, 0].any() and rays[:, :, 1:].min() >= 1 - 1e-5
    assert rays.max() == pytest.approx(4 / 3)


@torch.no_grad()
def test_weights_of_single_rays_compare_the_rays_of_one_view():
    """The mean logit of the rays that meet the grid is zero in each view, also where half of the
    detector misses it, so that they do not weight cameras; each view's depend on it alone.
    """
    grid, cameras = small_rig()
    aside = replace(cameras, origin=cameras.origin + 4 * cameras.u)
    A, method = PROJECTORS.build("drr", grid=grid, cameras=aside), stirred("cross_view")
    y, g = A(blob(A)), Geometry.of(A)
    r = torch.randn_like(y)
    factors, reached = method.ray_net(g, y, r)[0], (g.row > 0).expand_as(y)
    assert not reached.all() and factors.min() < 0.9 and factors.max() > 1.1
    logits = (factors / (2 - factors)).log() * reached
    assert logits.sum(dim=(3, 4)).abs().max() < 1e-3 * logits.abs().max()
    r[:, :, 1] *= -1
    changed = (method.ray_net(g, y, r)[0] != factors).flatten(3).any(dim=3)
    assert changed.tolist() == [[[False, True, False, False]]]
    assert torch.equal(small("cross_view").ray_net(g, y, r)[0], torch.ones_like(y))


@torch.no_grad()
def test_corrected_rays_are_those_of_their_view_that_meet_the_grid():
    """Views are as measured before training, and where rays miss the grid."""
    grid, cameras = small_rig()
    aside = replace(cameras, origin=cameras.origin + 4 * cameras.u)
    A, method = PROJECTORS.build("drr", grid=grid, cameras=aside), stirred("cross_view")
    y, g = A(blob(A)), Geometry.of(A)
    r = torch.randn_like(y)
    assert torch.equal(small("cross_view").ray_net(g, y, r)[1], y)
    change = method.ray_net(g, y, r)[1] - y
    assert change.any() and not change[(g.row == 0).expand_as(y)].any()


def test_a_constant_in_one_view_is_learned_and_removed():
    """As smooth scatter is, which no weight of rays removes: 60 steps on one object."""
    A, method = small_projector(), small("cross_view", reweight=4)
    truth = blob(A)
    views = A(truth)
    views[:, :, 1] += 0.2 * views.amax()
    adam = torch.optim.Adam(method.ray_net.parameters(), 1e-2)

    def error() -> torch.Tensor:
        return (method(views, A).volume - truth).square().mean()

    before = error().item()
    for _ in range(60):
        adam.zero_grad()
        error().backward()
        adam.step()
    assert error().item() < 0.5 * before


@pytest.mark.parametrize("strength", [1.0, 3.0])
@torch.no_grad()
def test_rays_of_a_camera_without_weight_are_ignored(strength):
    """From a start that is given, before training; with a strength above one, too: no ray counts
    less than nothing.
    """
    A, method = small_projector(), small("cross_view")
    volume, own = blob(A), method.ray_weights
    method.log_strength.fill_(math.log(strength) / STRENGTH_RATE_FACTOR)
    method.start = lambda *_: volume

    def without_the_second(frames, x, weights, like):
        weights = weights.clone()
        weights[:, 1] = 0
        return own(frames, x, weights / weights.sum(dim=1, keepdim=True), like)

    views = 1.1 * A(volume)
    other = views.clone()
    other[:, :, 1] *= 2
    assert not torch.allclose(method(views, A).volume, method(other, A).volume, rtol=1e-2)
    method.ray_weights = without_the_second
    expected = method(views, A).volume
    assert torch.equal(method(other, A).volume, expected)
    assert not torch.allclose(expected, volume, rtol=1e-2)


@torch.no_grad()
def test_reweighted_sirt_leaves_out_a_camera_without_weight():
    """The volume is that of SIRT on the views of all others, and stays where no ray counts."""
    A = small_projector()
    views, weights = A(blob(A)), torch.ones(1, 1, *A.range_shape)
    views[:, :, 1] *= 2
    weights[:, :, 1] = 0
    others = view_subset(A, [0, 2, 3])
    start = torch.full((1, 1, *A.grid.shape), 0.1)
    geometry = Geometry.of(A)
    row = geometry.row[:, :, [0, 2, 3]]
    column = inverse_sums(others.T(torch.ones_like(row)))
    kept = others.T(torch.ones_like(row)) * geometry.column > MIN_SENSITIVITY_SHARE
    expected = sirt(
        others, views[:, :, [0, 2, 3]], 8, True, True, SirtWeights(row, column * kept), start=start
    )
    volume = reweighted(geometry, start, views, weights, 8)
    torch.testing.assert_close(volume, expected)
    assert not torch.allclose(volume, sirt(A, views, 8, momentum=True, start=start), rtol=1e-2)
    assert torch.equal(reweighted(geometry, start, views, 0 * weights, 8), start)


def test_reweighted_sirt_has_the_gradients_of_all_its_iterations():
    """In weights and start, by finite differences in float64, where no voxel is clipped."""
    A = small_projector()
    generator = torch.Generator().manual_seed(0)
    weights, direction = (
        0.5 + torch.rand(1, 1, *A.range_shape, generator=generator, dtype=torch.float64)
        for _ in range(2)
    )
    start = 1 + torch.rand(1, 1, *A.grid.shape, generator=generator, dtype=torch.float64)
    views, geometry = A(start + 0.1), Geometry.of(A, torch.float64)

    def error(move: Tensor) -> Tensor:
        volume = reweighted(geometry, start + move, views, weights + move * direction, 4)
        return volume.square().sum()

    move = torch.zeros((), dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(error, move, eps=1e-5, rtol=1e-6)


@pytest.mark.parametrize("options", [{}, {"fusion": "mean"}, {"weigh_rays": False}], ids=str)
@torch.no_grad()
def test_without_learned_weights_reweighting_continues_sirt(options):
    A = small_projector()
    views = A(blob(A))
    weights = Geometry.of(A).weights
    expected = sirt(A, views, 3, momentum=True, weights=weights)
    expected = sirt(A, views, 5, momentum=True, weights=weights, start=expected)
    expected = sirt(A, views, 2, nonnegative=False, weights=weights, start=expected)
    volume = small("cross_view", reweight=5, **options)(views, A).volume
    torch.testing.assert_close(volume, expected.clamp_min(0), rtol=1e-4, atol=1e-5)


@pytest.mark.filterwarnings("ignore:Rays are up to")
@torch.no_grad()
def test_the_volume_is_zero_only_outside_the_support():
    A = small_projector()
    out = stirred("cross_view", support="hull")(A(blob(A, 2)), A)
    assert 0 < out.support.float().mean() < 1
    for volume in (out.volume, out.start):
        assert not (volume * ~out.support).any() and volume.any()
    cells = avg_pool3d(out.support.float(), 2) > 0
    change = out.per_view - avg_pool3d(out.start, 2)[:, None]
    assert not (change * ~cells[:, None]).any() and change.any()


@pytest.mark.filterwarnings("ignore:Rays are up to")
@pytest.mark.parametrize("options", [{"support": "auto"}, OPTIONS["crop"]], ids=str)
def test_a_zero_sample_has_an_empty_hull_and_finite_gradients(options):
    A, method = small_projector(), stirred("cross_view", **options)
    truth = blob(A, 2)
    truth[1] = 0
    volume = method(A(truth), A).volume
    assert volume[0].any() and not volume[1].any()
    volume.square().sum().backward()
    assert all(p.grad.isfinite().all() for p in method.parameters() if p.grad is not None)


@pytest.fixture(scope="module")
def wide():
    """An operator on a grid of which a crop is a small part."""
    return small_projector(size=32, pixels=32)


@pytest.mark.filterwarnings("ignore:Rays are up to")
@torch.no_grad()
def test_a_crop_is_per_sample_and_a_full_crop_changes_nothing(wide):
    volume = torch.zeros(2, 1, 32, 32, 32)
    volume[0, :, 12:17, 12:17, 13:18] = 1.0
    volume[1, :, 8:20, 14:20, 4:18] = 1.0
    views, method, shapes = wide(volume), stirred("cross_view", **OPTIONS["crop"]), []
    hook = method.volume_net.register_forward_hook(lambda *call: shapes.append(call[2].shape[2:]))
    both = method(views, wide).volume
    hook.remove()
    assert len(set(shapes)) == 2 and min(shape.numel() for shape in shapes) < 32**3
    for own, alone in zip(both.split(1), views.split(1), strict=True):
        torch.testing.assert_close(method(alone, wide).volume, own, rtol=1e-5, atol=1e-5)
    everywhere = wide(torch.ones(1, 1, 32, 32, 32))
    cropped, method.crop = method(everywhere, wide).volume, False
    assert torch.equal(method(everywhere, wide).volume, cropped)


@pytest.mark.filterwarnings("ignore:Rays are up to")
@torch.no_grad()
def test_a_crop_uses_the_features_of_its_own_voxels(wide):
    """A volume network that looks at fused features alone gives inside the box the same as on the
    whole grid.
    """
    volume = torch.zeros(1, 1, 32, 32, 32)
    volume[:, :, 20:24, 13:17, 12:18] = 1.0
    method, shapes = stirred("cross_view", **OPTIONS["crop"]), []
    net, entry = method.volume_net, method.entry.weight
    for block in (*net.down, *net.up):
        block.second.weight.zero_()
    net.first.weight.zero_()
    entry.normal_(std=10.0)
    net.register_forward_hook(lambda *call: shapes.append(call[2].shape[2:].numel()))
    views = wide(volume)
    cropped, method.crop = method(views, wide).volume, False
    whole = method(views, wide).volume
    assert shapes[0] < shapes[1] == 32**3
    torch.testing.assert_close(cropped, whole, rtol=1e-5, atol=1e-5 * whole.abs().max().item())
    entry.zero_()
    assert (method(views, wide).volume - whole).abs().max() > 1e-2 * whole.abs().max()


@torch.no_grad()
@pytest.mark.parametrize("weigh_rays", [True, False])
def test_final_expectation_maximisation_conserves_counts(weigh_rays):
    """Before and after training: sensitivity times activity is the number of counts, each counted
    by its ray's weight. These are one before training and without `weigh_rays`.
    """
    A = small_projector(pixels=8)
    counts = torch.poisson(20 * A(blob(A) + 0.2), torch.Generator().manual_seed(0))
    start = {"name": "osem", "iterations": 2, "subsets": 2}
    for build in (small, stirred):
        method = build("cross_view", start=start, consistency=EM, weigh_rays=weigh_rays)
        method.consistency.lengths.fill_(1.0)
        out = method(counts, A)
        weights = torch.ones_like(counts) if out.ray_weights is None else out.ray_weights
        if build is small or not weigh_rays:
            torch.testing.assert_close(weights, torch.ones_like(counts))
        explained, measured = (weights * A(out.volume)).sum(), (weights * counts).sum()
        assert explained.item() == pytest.approx(measured.item(), rel=1e-4)
        assert out.entry is not None


class Even(torch.nn.Module):
    """A head with a uniform density as its prior."""

    def __init__(self, head):
        super().__init__()
        self.head = head

    def forward(self, logits, prior, views, frusta):
        return self.head(logits, torch.ones_like(prior), views, frusta)


@pytest.mark.parametrize("options", [{}, OPTIONS["head"], OPTIONS["shared"]], ids=str)
@pytest.mark.parametrize("network", [True, False])
@pytest.mark.parametrize("depth", ["prior", "uniform"])
@torch.no_grad()
def test_depths_that_are_not_learned_are_those_of_zero_logits(depth, network, options):
    """The learned model with the same weights, but for zeros in the logits' channel of the depth
    network, or in the whole network where there is none; with either head, shared or not.
    """
    widths = {} if network else {"depth_widths": []}
    A, method = small_projector(), stirred("cross_view", depth=depth, **widths, **options)
    learned = stirred("cross_view", **options)
    state, own = learned.state_dict(), method.state_dict()
    of_network = {name for name in state if name.startswith(("estimates.image", "estimates.unet"))}
    assert state.keys() - own.keys() == (set() if network else of_network)
    assert not own.keys() - state.keys()
    for name in of_network:
        if not network:
            state[name].zero_()
    for name, value in own.items():  # confidence and features are the last channels
        place = state[name][:, : value.shape[1]] if value.ndim == 5 else state[name]
        place.copy_(value)
        if ".last." in name and name in of_network:
            place[0] = 0
    if depth == "uniform":
        learned.estimates.head = Even(learned.estimates.head)
    views = A(blob(A))
    out, expected = method(views, A), learned(views, A)
    for name in ("volume", "per_view", "weights", "predictions"):
        torch.testing.assert_close(getattr(out, name), getattr(expected, name))
    untrained = small("cross_view", depth=depth, **widths, **options)
    assert not torch.equal(out.volume, untrained(views, A).volume)


@pytest.mark.parametrize("depth", ["learned", "prior", "uniform"])
def test_only_learned_depths_depend_on_the_logits(depth):
    """Confidence and features count with all depths."""
    A, method = small_projector(), stirred("cross_view", depth=depth)
    method(A(blob(A)), A).volume.square().sum().backward()
    logits, *others = method.estimates.unet.last.weight.grad.abs().flatten(1).sum(1).tolist()
    assert (logits > 0) == (depth == "learned") and min(others) > 0


@torch.no_grad()
def test_rays_that_miss_the_grid_have_no_effect():
    grid, cameras = small_rig()
    far = replace(cameras, u=3 * cameras.u, origin=cameras.origin - 11 * cameras.u)
    A = PROJECTORS.build("drr", grid=grid, cameras=far)
    views, method = A(blob(A)), stirred("cross_view", binning=1)
    missing = (A(torch.ones(1, 1, 12, 12, 12)) == 0).expand_as(views)
    other = views + missing * 1.0
    assert missing.any() and method(views, A).volume.any()
    change = (method(other, A).volume - method(views, A).volume).norm()
    assert change < 1e-4 * method(views, A).volume.norm()


@pytest.mark.parametrize(
    ("options", "error", "message"),
    [
        ({"fusion": "median"}, ValueError, "fusion must be one of weighted, mean, got 'median'"),
        ({"weighting": "nett"}, LookupError, "No weighting is named 'nett'"),
        ({"weighting": {"widths": [4]}}, TypeError, "needs a 'name'"),
        ({"weighting": {"name": "unet", "width": [4]}}, TypeError, "did you mean 'widths'"),
        ({"weighting": {"name": "unet", "widths": []}}, ValueError, "at least one scale, got"),
        ({"depth_widths": []}, ValueError, "depth_widths of a scale for learned depths, got"),
        ({"weight_widths": []}, ValueError, "at least one scale, got"),
        ({"depth": "flat"}, ValueError, "depth must be one of learned, prior, uniform, got 'flat'"),
        ({"support": "cone"}, ValueError, "support must be one of"),
        ({"scale": 3}, ValueError, "scale below the 3 of widths, got 3"),
        ({"shared": False}, ValueError, "n_cameras for networks that are not shared"),
        ({"crop": True}, ValueError, "got crop=True and support='none'"),
        ({"head": "softmax"}, LookupError, "did you mean 'softmax_depth'"),
        ({"consistency": -1}, ValueError, "0 consistency steps or more"),
        ({"reweight": -1}, ValueError, "reweight of 0 or more"),
        ({"reweight": 3, "consistency": EM}, ValueError, "of 0 for counts"),
        ({"start": {"iterations": 3}}, TypeError, "needs a 'name'"),
        ({"start": {"name": "fista_vt"}}, LookupError, "did you mean 'fista_tv'"),
    ],
)
def test_inconsistent_options_are_refused(options, error, message):
    """Options of the cross-view model that do not exist, or do not fit one another, are refused."""
    with pytest.raises(error, match=message):
        CrossView(**options)
