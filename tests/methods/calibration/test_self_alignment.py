"""Wrong cameras are detected from the views alone, without displacing the object."""

import math
import warnings

import pytest
import torch

from mvrecon.core.parts import PROJECTORS, SCENES
from mvrecon.data.acquisition.disturbances import Disturbance, rig_errors
from mvrecon.data.scenes.solids import Phantom, Solids
from mvrecon.geometry.cameras.rigs import circular, parallel
from mvrecon.geometry.grid import Grid, voxel_centres
from mvrecon.methods.calibration.alignment import least_deviations, translated
from mvrecon.methods.calibration.from_data import motions
from mvrecon.methods.calibration.self_alignment import (
    Aligned,
    self_aligned,
    share_beside,
    standing_still,
)
from mvrecon.methods.classical.sirt import sirt
from mvrecon.methods.method import Alignment
from mvrecon.operators.selection import view_subset
from tests.methods.learned.rig import small_rig


@pytest.fixture(scope="module")
def measurement():
    """An operator, and views of ellipsoids that are exact."""
    grid, cameras = small_rig(n_views=8, size=24, pixels=36)
    scene = SCENES.build("ellipsoids")
    views = torch.stack([scene.sample(i, 0, grid, cameras).views for i in range(2)])
    return PROJECTORS.build("drr", grid=grid, cameras=cameras), views


@pytest.fixture(scope="module")
def disturbed(measurement):
    A, views = measurement
    rng = torch.Generator().manual_seed(1)
    disturbance = Disturbance(views=3, shift_px=1.0, gain=0.05)
    errors = [rig_errors(disturbance, A.cameras, rng) for _ in views]
    shift = torch.stack([one.shift_px for one in errors]).float()
    gain = torch.stack([one.gain for one in errors]).float()
    return translated(views, shift) * gain[:, None, :, None, None], shift, gain


def test_three_wrong_cameras_of_eight_are_detected_and_corrected(measurement, disturbed):
    (A, exact), (views, shift, gain) = measurement, disturbed
    corrected, by = self_aligned(A, views)
    assert by is not None
    assert (by.shift_px - shift).square().mean().sqrt() < 0.15 * shift.square().mean().sqrt()
    assert (by.gain - gain).square().mean().sqrt() < 0.5 * (gain - 1).square().mean().sqrt()
    wrong = shift.abs().sum(dim=-1) > 0
    assert by.deviation()[wrong].min() > by.deviation()[~wrong].max()
    assert (corrected - exact).norm() < 0.25 * (views - exact).norm()


def test_exact_views_do_not_change(measurement):
    A, views = measurement
    by = self_aligned(A, views).alignment
    assert by.shift_px.abs().max() < 0.06 and (by.gain - 1).abs().max() < 0.02


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16, torch.float64])
def test_views_of_any_precision_are_aligned(measurement, disturbed, dtype):
    A, views = measurement[0], disturbed[0][:1]
    out = Aligned({"name": "sirt", "iterations": 2})(views.to(dtype), A)
    expected = self_aligned(A, views).alignment
    assert (out.alignment.shift_px - expected.shift_px).abs().max() < 0.05
    assert out.volume.dtype == torch.promote_types(dtype, torch.float32)


def test_object_motion_and_a_common_gain_are_not_camera_errors(measurement):
    A, _ = measurement
    moves = motions(A.cameras, A.grid.centre).float()
    wrong = torch.zeros(1, 8, 2)
    wrong[0, [1, 4, 6]] = torch.tensor([[0.7, -0.3], [-0.5, 0.9], [0.8, 0.8]])
    shift = wrong + moves @ torch.tensor([0.2, -0.3, 0.1])
    gain = torch.ones(1, 8)
    gain[0, 1] = 1.05
    none = Alignment.none(torch.zeros(1, 1, 8, 1, 1))
    by = Alignment(shift, 1.3 * gain, none.shift_error, none.gain_error)
    still = standing_still(by, moves)
    torch.testing.assert_close(still.shift_px, wrong, rtol=0, atol=0.02)
    torch.testing.assert_close(still.gain, gain, rtol=0, atol=1e-3)


def test_a_motion_moves_points_as_the_cameras_see_them(measurement):
    cameras, centre = measurement[0].cameras, torch.tensor([3.0, -2.0, 4.0]).double()
    step = torch.tensor([0.2, -0.1, 0.3]).double()
    places = cameras.project(torch.stack([centre, centre + step]))[..., :2]
    torch.testing.assert_close(
        motions(cameras, centre) @ step, places[:, 1] - places[:, 0], rtol=0, atol=2e-3
    )


def test_values_that_the_modes_cannot_explain_remain():
    values = torch.tensor([[[1.0], [1.0], [4.0]]])
    modes = torch.ones(3, 1, 1)
    expected = torch.tensor([[[0.0], [0.0], [3.0]]])
    torch.testing.assert_close(least_deviations(values, modes, 1e-3), expected, rtol=0, atol=1e-3)
    torch.testing.assert_close(least_deviations(values, 0 * modes, 1e-3), values)


def test_views_that_are_not_finite_are_refused(measurement):
    """Alignment of views by themselves refuses values that are not finite, and no alternation."""
    A, views = measurement
    with pytest.raises(ValueError, match="alternation"):
        self_aligned(A, views, alternations=0)
    with pytest.raises(ValueError, match="finite"):
        self_aligned(A, views.index_fill(2, torch.tensor([1]), torch.nan))


def test_no_view_is_lost_by_noise(measurement):
    """Rays that graze the grid's corners measure only noise over a short length."""
    A, views = measurement
    noise = torch.randn(views.shape, generator=torch.Generator().manual_seed(2))
    noisy = views + 0.1 * views.amax() * noise
    assert (self_aligned(A, noisy).alignment.gain > 0.5).all()


@pytest.mark.parametrize("fault", ["dead", "overexposed"])
def test_a_lost_view_is_replaced_by_what_all_others_predict(fault, measurement, disturbed):
    """And the other cameras are righted as well as without it."""
    A, truth = measurement
    views, shift, gain = disturbed
    views = views.clone()
    views[:, :, 6] = 0 if fault == "dead" else views[:, :, 6].clamp(min=0.7 * views.amax())
    corrected = self_aligned(A, views)
    by = corrected.alignment
    assert by is not None and (by.gain[:, 6] == 0).all() and (by.gain[:, :6] > 0.9).all()
    others = [m for m in range(8) if m != 6]
    error = (by.shift_px - shift)[:, others].square().mean().sqrt()
    assert error < 0.15 < shift[:, others].square().mean().sqrt()
    missed = (corrected.views - truth)[:, :, 6].norm() / truth[:, :, 6].norm()
    assert missed < 0.1, "an empty view would miss all of it"
    volume = sirt(A, corrected.views, 20, momentum=True)
    kept = sirt(view_subset(A, others), corrected.views[:, :, others], 20, momentum=True)
    assert (volume - kept).norm() < 0.1 * kept.norm()


def error(A, views, truth):
    return ((sirt(A, views, 20, momentum=True) - truth).norm() / truth.norm()).item()


@pytest.mark.parametrize(("factor", "away"), [(1e-2, 120.0), (100.0, 95.0)])
def test_views_of_an_object_far_off_the_axis_are_not_lost(factor, away):
    """An object 95 and 120 mm off the axis at a source distance of 300 mm, of any attenuation. Also
    tried: 60 mm, 8 to 60 views, a truncated object, objects of one voxel, off along z.
    """
    grid = Grid.centred(32, spacing=10.0)
    cameras = circular(24, 300.0, 450.0, {"pixels": [30, 36], "pixel_mm": 18.0})
    A = PROJECTORS.build("drr", grid=grid, cameras=cameras)
    apart = (voxel_centres(grid) - torch.tensor([away, 0.0, 20.0])).norm(dim=-1)
    volume = factor * 0.02 * (apart < 38).float()[None, None]
    views = A(volume)
    corrected, by = self_aligned(A, views)
    assert by is not None and (by.gain > 0.9).all()
    assert error(A, corrected, volume) < 1.1 * error(A, views, volume)


BALLS = {"off": [(45, 0, 0, 10), (48, 3, 4, 4)], "truncated": [(0, 0, 0, 62), (40, 20, 0, 12)]}


@pytest.mark.pairwise(fault=["third", "all", "overexposed"], shape=BALLS)
def test_exposures_that_differ_threefold_are_calibrated(shape, fault):
    """A third of the views by three, or all between a third and three, up to a common factor; and
    three overexposed views of 15 make no other view lost. Also tried: centred balls, two small ones
    and a plate, 2 to 5 views. Exposures of a ball of three voxels' width are not calibrated.
    """
    grid, rng = Grid.centred(32, spacing=4.0), torch.Generator().manual_seed(3)
    cameras = circular(15, 300.0, 450.0, {"pixels": [32, 32], "pixel_mm": 6.5})
    A, places = PROJECTORS.build("drr", grid=grid, cameras=cameras), voxel_centres(grid)
    balls = [(places - torch.tensor(c).double()).norm(dim=-1) < r for *c, r in BALLS[shape]]
    truth = 0.01 * sum(ball.float() for ball in balls)[None, None]
    clean, gains = A(truth), torch.ones(15)
    wrong = torch.randperm(15, generator=rng)[: 3 if fault == "overexposed" else 5].sort().values
    views = clean.clone()
    if fault == "overexposed":
        views[:, :, wrong] = clean.max()
    else:
        gains[wrong] = 3.0
        if fault == "all":
            gains = (2.2 * torch.rand(15, generator=rng) - 1.1).exp()
        views = clean * gains[:, None, None]
    corrected, by = self_aligned(A, views)
    dropped = (by.gain[0] == 0).nonzero().flatten()
    assert torch.equal(dropped, wrong if fault == "overexposed" else wrong[:0])
    factor = 1.0 if fault == "overexposed" else (clean.norm() / corrected.norm()).item()
    limit = 1.8 if fault == "overexposed" else 1.1
    assert error(A, factor * corrected, truth) < limit * error(A, clean, truth)


@pytest.mark.parametrize("fault", ["mirrored", "noise"])
def test_views_that_the_others_do_not_explain_spoil_no_prediction(fault):
    """Two mirrored views of a ball off the axis are lost, and only these: the gain by which they
    fit best is not applied. Noise above a ball of three voxels' width makes no view lost. Also
    tried: cones, arcs, fans, balls at the rim of the grid, rods, plates; 2 to 40 views.
    """
    grid = Grid.centred(24, spacing=5.0)
    rig = parallel(12, {"pixels": [28, 32], "pixel_mm": 4.0}, depth_mm=400.0)
    A, places = PROJECTORS.build("radon", grid=grid, cameras=rig), voxel_centres(grid)
    centre, radius = ((38.0, 0.0, 0.0), 14.0) if fault == "mirrored" else ((10.0, 5.0, 0.0), 6.0)
    truth = ((places - torch.tensor(centre).double()).norm(dim=-1) < radius).float()[None, None]
    views, wrong = A(truth), [5, 8] if fault == "mirrored" else []
    views[:, :, wrong] = views[:, :, wrong].flip(-1)
    if fault == "noise":
        rng = torch.Generator().manual_seed(0)
        views = views + 0.2 * views.amax() * torch.randn(views.shape, generator=rng)
    corrected, by = self_aligned(A, views)
    assert (by.gain[0] == 0).nonzero().flatten().tolist() == wrong
    limit = 0.7 if fault == "mirrored" else 1.02
    assert error(A, corrected, truth) < limit * error(A, views, truth)


@pytest.mark.parametrize("gain", [0.3, 3.0])
def test_the_level_of_a_view_is_calibrated(measurement, gain):
    """And no view is lost by it, be it one or three of eight."""
    A, views = measurement
    for wrong in ([6], [1, 2, 6]):
        gains = torch.ones(8)
        gains[wrong] = gain
        corrected, by = self_aligned(A, views[:1] * gains[:, None, None])
        assert by is not None and (by.gain[0] / gains - 1).abs().max() < 0.02
        assert (corrected - views[:1]).norm() < 0.01 * views[:1].norm()


@pytest.mark.pairwise(empty=[[6], [0, 1, 2], [1, 3, 5, 7], [0, 3, 4, 6]], fault=["empty", "noise"])
def test_up_to_half_of_the_views_are_lost(measurement, empty, fault):
    """Empty views and views of noise, in a row or not; the others predict them."""
    A, exact = measurement
    views, rng = exact[:1].clone(), torch.Generator().manual_seed(0)
    noise = exact.amax() * torch.rand(views.shape, generator=rng)
    views[:, :, empty] = 0 if fault == "empty" else noise[:, :, empty]
    corrected, by = self_aligned(A, views)
    assert by is not None and (by.gain[0] == 0).nonzero().flatten().tolist() == empty
    truth = sirt(A, exact[:1], 20, momentum=True)
    assert error(A, corrected, truth) < 0.5 * error(A, views, truth)


@pytest.mark.parametrize("count", [5, 7])
def test_where_most_views_are_lost_none_is_replaced(measurement, count):
    """With a warning; the volume is not zero."""
    A, exact = measurement
    views = exact.clone()
    views[:1, :, :count] = 0
    corrected, by = self_aligned(A, views)
    assert torch.equal(corrected[0], views[0]) and by is not None
    assert (by.gain[0] == 1).all() and not by.shift_px[0].any()
    assert (by.gain[1] > 0.9).all() and by.gain_error[1].any(), "the second sample is aligned"
    with pytest.warns(UserWarning, match="no view is aligned or replaced"):
        volume = Aligned({"name": "sirt", "iterations": 3})(views, A).volume
    assert volume[0].max() > 0


@pytest.mark.parametrize("method", ["mlem", "osem"])
def test_methods_of_counts_run_on_aligned_counts(measurement, method):
    A, views = measurement
    rng = torch.Generator().manual_seed(0)
    counts = torch.poisson(3 * views[:1] / views.mean(), generator=rng)
    out = Aligned({"name": method, "iterations": 2})(counts, A)
    assert out.volume.isfinite().all() and out.volume.min() >= 0 and out.volume.max() > 0


def test_views_beside_which_the_object_lies_are_not_lost():
    """A ball beside a small panel in two of twelve views, and one view that is dead. Also tried:
    two balls, panels of 14 and 16 columns, 12 to 20 views, up to 45 % of them dead.
    """
    grid = Grid.centred(24, spacing=5.0)
    rig = circular(12, 300.0, 450.0, {"pixels": [20, 14], "pixel_mm": 6.0})
    centre = torch.tensor([42.0, 0.0, 0.0])
    volume = 0.02 * ((voxel_centres(grid) - centre).norm(dim=-1) < 12).float()
    A = PROJECTORS.build("drr", grid=grid, cameras=rig)
    views = A(volume[None, None])
    empty = ~views.flatten(3).any(dim=3)[0, 0]
    views[:, :, 6] = 0
    gain = self_aligned(A, views).alignment.gain[0]
    assert empty.sum() == 2 and (gain == 0).nonzero().flatten().tolist() == [6]


@pytest.mark.pairwise(make=[circular, parallel], dead=[False, True], fault=["none", "gains"])
def test_views_that_narrow_panels_leave_empty_are_not_lost(make, dead, fault):
    """A ball in closed form beside the panel in two to six of twelve views: its empty views are
    explained by where they do not see, a dead one is not. Also tried: 80 rigs of 8 to 20 views of
    panels of 8 to 16 columns, one and two ellipsoids, gains, shifts of a quarter of the views, of
    which three, all with shifts or gains of several views, still lose a right one (before: half).
    """
    distances, pitch, columns = ((), 4.0, 14) if make is parallel else ((300.0, 450.0), 6.0, 12)
    rig = make(12, *distances, {"pixels": [20, columns], "pixel_mm": pitch})
    grid, centre = Grid.centred(24, spacing=5.0), torch.tensor([38.0, 12.0, 0.0]).double()
    start, end = (x.double() for x in rig.rays())
    way = torch.nn.functional.normalize(end - start, dim=-1)
    apart = torch.linalg.cross(centre - start, way).square().sum(dim=-1)
    views = 0.04 * (12.0**2 - apart).clamp_min(0).sqrt()
    empty = ~views.flatten(1).any(dim=1)
    lost = [int(views.flatten(1).norm(dim=1).argmax())] if dead else []
    if fault == "gains":
        views[(~empty).nonzero()[[1, 4], 0]] *= torch.tensor([0.6, 1.7]).view(2, 1, 1)
    views[lost] = 0
    A = PROJECTORS.build("radon" if make is parallel else "drr", grid=grid, cameras=rig)
    gain = self_aligned(A, views[None, None].float()).alignment.gain[0]
    assert 2 <= empty.sum() <= 6 and (gain == 0).nonzero().flatten().tolist() == lost


@pytest.mark.parametrize("wrong", [False, True])
def test_truncated_views_are_aligned_only_where_this_improves_prediction(wrong):
    """Two balls beside a small panel: views without errors stay, with a warning; a fifth of them
    shifted by 1.3 pixels is aligned. Also tried: panels of 12 and 20 columns, one ball, 12 views,
    shifts of 3 pixels.
    """
    grid = Grid.centred(24, spacing=5.0)
    rig = circular(20, 300.0, 450.0, {"pixels": [20, 16], "pixel_mm": 6.0})
    balls = [((42.0, 0.0, 0.0), 12.0), ((-20.0, 30.0, 0.0), 12.0)]
    apart = [(voxel_centres(grid) - torch.tensor(c).double()).norm(dim=-1) / r for c, r in balls]
    volume = 0.02 * sum((one < 1).float() for one in apart)[None, None]
    A = PROJECTORS.build("drr", grid=grid, cameras=rig)
    views = A(volume)
    if wrong:
        shift = torch.zeros(1, 20, 2)
        shift[0, ::5] = torch.tensor([1.0, -0.8])
        views = translated(views, shift)
        corrected, _ = self_aligned(A, views)
        assert error(A, corrected, volume) < 0.9 * error(A, views, volume)
        return
    with pytest.warns(UserWarning, match="they are not aligned"):
        corrected, by = self_aligned(A, views)
    assert torch.equal(corrected, views) and not by.shift_px.any() and (by.gain == 1).all()


@pytest.mark.parametrize("off", [0.0, 0.06])
def test_an_object_higher_than_the_rows_of_parallel_beams_is_aligned_as_a_complete_one(off):
    """Rows see a slice each, so that nothing lies beside what they show: right views stay without a
    warning, and doses that are a few per cent off are found. Also tried: doses of 0.5 to 1.2, two
    empty views, shifts of 1 to 2 pixels along rows and columns.
    """
    rig = parallel(24, {"pixels": [10, 44], "pixel_mm": 2.5})
    centres = torch.tensor([[3.0, -2.0, 0.0], [11.0, 6.0, 3.0], [-13.0, -5.0, -4.0]])
    sizes = torch.tensor([[32.0, 24.0, 300.0], [8.0, 5.0, 200.0], [6.0, 6.0, 7.0]])
    values, turn = torch.tensor([0.02, 0.015, -0.01]), torch.eye(3).expand(3, 3, 3)
    body = Phantom((Solids("ellipsoid", centres, turn, sizes, values),))
    gain = torch.ones(24)
    gain[[3, 9, 15, 20]] += torch.tensor([off, -off, off, -off])
    views = (body.integrals(*rig.rays()).float() * gain[:, None, None])[None, None]
    grid = Grid.centred(size=(34, 34, 10), spacing=2.5)
    A = PROJECTORS.build("radon", grid=grid, cameras=rig)
    with warnings.catch_warnings(action="error"):
        corrected, by = self_aligned(A, views)
    assert (by.gain[0] - gain).abs().max() < 0.01
    assert off or torch.equal(corrected, views)


@pytest.mark.parametrize("flat", [0.0, 0.03, 0.05 * torch.linspace(0, 1, 36), "noise"])
@pytest.mark.parametrize(("size", "held"), [(28, True), (18, False), (13, False)])
def test_a_grid_that_does_not_hold_the_object_is_said_where_its_views_are_not_aligned(
    size, held, flat
):
    """An ellipsoid in closed form, of 26 voxels a side, misaligned in two views: flat fields that
    are off and noise of 100 photons are no object beside the grid. Also tried: grids that miss
    0.001 to 0.35 of the line integrals, right views, `method=aligned`.
    """
    rig = circular(12, 200.0, 400.0, {"pixels": [36, 36], "pixel_mm": 4.0})
    radii = torch.tensor([[26.0, 22.0, 24.0]])
    solid = Solids("ellipsoid", torch.zeros(1, 3), torch.eye(3)[None], radii, torch.tensor([0.03]))
    offset = torch.zeros(12, 2, dtype=torch.float64)
    offset[3], offset[7] = torch.tensor([1.2, -0.7]), torch.tensor([-0.9, 0.8])
    start, end = rig.shifted(offset).rays()
    views = Phantom((solid,)).integrals(start, end, rig.ray_extent).float()[None, None]
    if flat == "noise":
        counts = torch.poisson(100 * (-views).exp(), torch.Generator().manual_seed(0))
        views = -(counts.clamp_min(1) / 100).log()
    else:
        views = views + flat
    A = PROJECTORS.build("drr", grid=Grid.centred(size, spacing=2.0), cameras=rig)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        by = self_aligned(A, views).alignment
    said = [line for line in caught if "extends beyond the grid" in str(line.message)]
    assert by.shift_px.any() == held and len(said) == (not held)


@pytest.mark.parametrize("fault", ["none", "flat", "hot pixel", "metal"])
@pytest.mark.parametrize(
    ("radius", "size"), [(80.0, 30.0), (80.0, 58.0), (34.0, 40.0), (24.0, 60.0)]
)
def test_the_share_of_an_object_outside_the_grid(radius, size, fault):
    """Of balls in closed form, also where a panel inside the object sees no air; the share is that
    of the rays that miss the box. Also tried: long cylinders, slabs, balls off the axis, noise of
    100 photons.
    """
    rig = circular(8, 300.0, 450.0, {"pixels": [60, 60], "pixel_mm": 2.0})
    grid = Grid.centred(60, spacing=size / 60)
    start, end = (x.double() for x in rig.rays())
    way = end - start

    def through(radius):
        a, b = way.square().sum(dim=-1), (way * start).sum(dim=-1)
        c = start.square().sum(dim=-1) - radius**2
        return 2 * ((b**2 - a * c).clamp_min(0) / a).sqrt()

    views = 0.01 * through(radius)
    sides = torch.stack([(side * size / 2 - start) / way for side in (-1, 1)])
    missed = sides.amin(dim=0).amax(dim=-1) >= sides.amax(dim=0).amin(dim=-1)
    views = views + (2.0 * through(2.0) if fault == "metal" else 0.0)
    share = (views * missed).sum() / views.sum()
    if fault == "hot pixel":
        views[3, 10, 10] = 20.0
    flat = 0.03 if fault == "flat" else 0.0
    A = PROJECTORS.build("drr", grid=grid, cameras=rig)
    found = share_beside(A, (views + flat)[None, None].float())
    assert found.item() == pytest.approx(share.item(), abs=0.03)


@pytest.mark.parametrize("fault", ["far", "counts", "narrow"])
def test_views_that_alignment_does_not_help_stay_as_measured(fault):
    """A quarter of 12 views shifted by 8 pixels, which are too many, photon noise, and a right rig
    with a panel of 16 columns: alignment raised the volume's error by 8, 2 and 17 %. Also tried:
    balls of 12 to 35 mm on and off the axis, five balls, parallel beams, right rigs with noise.
    """
    grid = Grid.centred(24, spacing=5.0)
    panel = {"pixels": [32, 16 if fault == "narrow" else 32], "pixel_mm": 6.0}
    A = PROJECTORS.build("drr", grid=grid, cameras=circular(12, 300.0, 450.0, panel))
    apart = (voxel_centres(grid) - torch.tensor([42.0, 0.0, 0.0]).double()).norm(dim=-1)
    views = A(0.02 * (apart < 12).float()[None, None])
    if fault == "far":
        for view, (u, v) in {2: (8, 0), 5: (-5, 6), 9: (3, -7)}.items():
            views[0, 0, view] = views[0, 0, view].roll((v, u), (-2, -1))
    if fault == "counts":
        unit, rng = views.max() / 20, torch.Generator().manual_seed(0)
        views = unit * torch.poisson(views / unit, rng)
    corrected, by = self_aligned(A, views)
    assert torch.equal(corrected, views) and not by.shift_px.any() and (by.gain == 1).all()


@pytest.mark.pairwise(count=[8, 20], fault=["right", "shifted", "dim"])
def test_half_panels_of_parallel_beams_take_no_gain_for_what_lies_beside_them(count, fault):
    """A ball before a half panel over half a turn, in closed form: gains of up to 7 % made up for
    what the panel does not see, and raised the volume's error by a quarter to two fifths. A third
    of the views shifted by 0.7 pixels are shifted alone; a third of 0.8 times the brightness, which
    raised the error by 37 to 57 %, is levelled. Also tried: balls, rods and ellipsoids, cones,
    narrow panels, arcs of 180 to 360 degrees, 5 to 24 views, dead views, noise of up to 3 %, shifts
    of up to 8 pixels, gains of 0.3 to 3.
    """
    grid, pitch, side = Grid.centred(24, spacing=3.5), 3.5, 10.5
    rig = parallel(count, {"pixels": [26, 18], "pixel_mm": pitch, "offset_mm": [0.0, side]})
    A, centre = PROJECTORS.build("radon", grid=grid, cameras=rig), torch.tensor([5.0, 0.0, 0.0])
    truth = 0.02 * ((voxel_centres(grid) - centre).norm(dim=-1) < 28).float()[None, None]
    shift = torch.zeros(count, 2, 1, 1)
    if fault == "shifted":
        shift[1::3] = torch.tensor([0.6, -0.4]).view(2, 1, 1)
    place = -5.0 * torch.sin(math.pi * torch.arange(count) / count)[:, None, None]
    u = pitch * (torch.arange(18) - 8.5 + shift[:, 0]) + side - place
    v = pitch * (torch.arange(26)[:, None] - 12.5 + shift[:, 1])
    views = (0.04 * (28**2 - u**2 - v**2).clamp_min(0).sqrt())[None, None]
    if fault == "dim":
        views[:, :, 1::3] *= 0.8
    corrected, by = self_aligned(A, views)
    limit = 1.0 if fault == "dim" else 1.03
    assert error(A, corrected, truth) < limit * error(A, views, truth)
    assert (by.gain == 1).all() == (fault != "dim") and by.shift_px.any() == (fault != "right")


@pytest.mark.parametrize("make", [circular, parallel])
def test_beams_of_one_row_are_aligned_as_panels_are(make):
    """A fan, and a slice of parallel beams, of ellipses in closed form, whose views are in random
    order: three shifted views and two of another dose. Also tried: views in order, no dose and
    doses alone, 12 views, a fifth of the views empty, noise of 10000 photons.
    """
    count, distances = 32, () if make is parallel else (200.0, 300.0)
    turn = torch.randperm(count, generator=torch.Generator().manual_seed(3))
    arc = 180 if make is parallel else 360
    pitch = 1.0 if make is parallel else 1.5
    detector = {"pixels": [1, 80], "pixel_mm": pitch}
    rig = make(count, *distances, detector, angles=(turn * (arc / count)).tolist())
    shift, gain = torch.zeros(count, 2).double(), torch.ones(count)
    shift[[3, 17, 30], 0] = torch.tensor([2.0, -1.5, 3.0]).double()
    gain[5], gain[22] = 1.3, 0.8
    start, end = (x.double() for x in rig.shifted(shift).rays())
    views = torch.zeros(start.shape[:-1]).double()
    for centre, axes, mu in (
        ((3.0, -4.0), (25.0, 18.0), 0.02),
        ((-8.0, 6.0), (6.0, 5.0), 0.02),
        ((12.0, 3.0), (4.0, 7.0), -0.01),
    ):
        p = (start[..., :2] - torch.tensor(centre).double()) / torch.tensor(axes).double()
        way = (end - start)[..., :2] / torch.tensor(axes).double()
        a, b = way.square().sum(dim=-1), (way * p).sum(dim=-1)
        root = (b.square() - a * (p.square().sum(dim=-1) - 1)).clamp_min(0).sqrt()
        views += 2 * mu * (end - start).norm(dim=-1) * root / a
    A = PROJECTORS.build(
        "radon" if make is parallel else "drr",
        grid=Grid.centred(size=(56, 56, 1), spacing=1.2),
        cameras=rig,
    )
    by = self_aligned(A, (views * gain[:, None, None])[None, None].float()).alignment
    assert (by.shift_px[0] - shift).abs().max() < 0.12
    assert (by.gain[0] / gain - 1).abs().max() < 0.01


@pytest.mark.parametrize("count", [1, 2, 3])
def test_few_right_views_stay_as_measured(count):
    """One view, which no other predicts, was shifted or scaled. Also tried: views of zero, half
    precision, batches of these.
    """
    rig = circular(count, 300.0, 450.0, {"pixels": [24, 24], "pixel_mm": 7.0})
    grid = Grid.centred(16, spacing=6.0)
    A, centre = PROJECTORS.build("drr", grid=grid, cameras=rig), torch.tensor([10.0, 5.0, 0.0])
    apart = (voxel_centres(grid) - centre).norm(dim=-1)
    views = A(0.02 * (apart < 25).float()[None, None]) * torch.tensor([1.0, 2.0]).view(
        2, 1, 1, 1, 1
    )
    corrected, by = self_aligned(A, views)
    assert torch.equal(corrected, views) and not by.shift_px.any() and (by.gain == 1).all()
