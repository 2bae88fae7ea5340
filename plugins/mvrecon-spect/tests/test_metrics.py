"""Figures of merit on volumes whose figures are known in closed form."""

import math

import pytest
import torch

from mvrecon.data.scenes.phantoms import derenzo
from mvrecon.data.scenes.solids import voxelise
from mvrecon.geometry.grid import Grid, voxel_centres
from mvrecon_spect.metrics.contrast import (
    ball_means,
    contrast_to_noise,
    count_bias,
    defect_contrast,
    sphere_recovery,
)
from mvrecon_spect.metrics.derenzo import valley_to_peak
from mvrecon_spect.metrics.edge import ball_mtf, plane_mtf
from mvrecon_spect.metrics.polar_map import LongAxis, polar_map, segments
from mvrecon_spect.metrics.repeated import repeated

GRID = Grid.centred(size=(40, 36, 32), spacing=2.0)


def distance(grid: Grid, centre=(0.0, 0.0, 0.0)) -> torch.Tensor:
    return (voxel_centres(grid) - torch.tensor(centre).double()).norm(dim=-1)


def test_the_mean_of_a_slope_in_a_ball_is_its_value_at_the_centre():
    slope = voxel_centres(GRID) @ torch.tensor([1.0, -2.0, 0.5]).double()
    centres = torch.tensor([[0.0, 0.0, 0.0], [11.0, 5.3, -7.1]]).double()
    means = ball_means(slope, GRID, centres, 20.0)
    torch.testing.assert_close(
        means, centres @ torch.tensor([1.0, -2, 0.5]).double(), atol=0.05, rtol=0
    )


def test_recovery_and_variability_match_their_definition():
    """A sphere at 3 where 5 were true, in a background of two levels."""
    hot, regions = torch.tensor([[0.0, 0.0, 0.0]]), torch.tensor([[-25.0, 0, 0], [25.0, 0, 0]])
    volume = torch.where(voxel_centres(GRID)[..., 0] < 0, 0.9, 1.1)
    volume[distance(GRID) < 12] = 3.0
    figures = sphere_recovery(volume, GRID, hot, torch.tensor([20.0]), regions, ratio=5.0)
    assert figures.contrast.item() == pytest.approx((3 - 1) / (5 - 1), rel=1e-6)
    assert figures.variability.item() == pytest.approx(0.2 / math.sqrt(2), rel=1e-6)
    volume[distance(GRID) < 12] = 0.25
    cold = sphere_recovery(volume, GRID, hot, torch.tensor([20.0]), regions, ratio=0.0)
    assert cold.contrast.item() == pytest.approx(0.75, rel=1e-6)


def test_contrast_noise_and_bias_by_hand():
    volume = torch.tensor([4.0, 6.0, 1.0, 3.0, 2.0, 2.0]).reshape(1, 2, 3)
    hot = torch.tensor([1, 1, 0, 0, 0, 0]).bool().reshape(1, 2, 3)
    assert contrast_to_noise(volume, hot, ~hot) == pytest.approx(3 / math.sqrt(2 / 3))
    assert count_bias(volume, torch.full_like(volume, 4.0), hot) == pytest.approx(0.25)
    assert defect_contrast(volume, ~hot, hot) == pytest.approx(1 - 2 / 5)


def test_the_valley_of_a_cosine_is_its_modulation():
    """1 - m cos(2 pi y / 2d) is m above one on both wells of the second row, and m below midway."""
    wells = (8, 8, 8, 8, 8, 8)
    grid = Grid.centred(size=(120, 120, 8), spacing=0.75)
    volume = voxelise(derenzo(wells, height=20.0), grid, 2)
    sharp = valley_to_peak(volume, grid, wells, height=5.0)
    assert all(s.resolved == 1.0 and s.ratios.max() < 1e-9 and len(s.ratios) == 3 for s in sharp)
    flat = valley_to_peak(torch.ones(grid.shape), grid, wells, height=5.0)
    assert all(s.resolved == 0.0 and s.ratios.sub(1).abs().max() < 1e-6 for s in flat)
    # the first sector's wells have y = 0, and -8 and 8 in the second row
    wave = 1 - 0.5 * torch.cos(2 * math.pi * voxel_centres(grid)[..., 1] / 16)
    ratios = valley_to_peak(wave, grid, wells, height=5.0)[0].ratios.sort().values
    torch.testing.assert_close(ratios, torch.tensor([1 / 3, 1, 1]).double(), rtol=0.02, atol=0)


def test_wells_follow_the_pose_of_the_phantom():
    grid = Grid.centred(64, spacing=1.5)
    pose = {"centre": (3.0, -2.0, 4.0), "euler_degrees": (20.0, 40.0, -70.0), "height": 40.0}
    wells = (8, 8, 7, 7, 6, 6)
    volume = voxelise(derenzo(wells, **pose), grid, 3)
    right = valley_to_peak(volume, grid, wells, **pose)
    assert [s.diameter for s in right] == list(wells)
    assert min(s.resolved for s in right) == 1.0 and all(s.ratios.max() < 0.25 for s in right)
    wrong = valley_to_peak(volume, grid, wells, **{**pose, "euler_degrees": (50.0, 40.0, -70.0)})
    assert min(s.resolved for s in wrong) < 1.0
    wide = Grid.centred(64, spacing=2.0)
    alone = valley_to_peak(torch.ones(wide.shape), wide, (16,) * 6, 60.0, 40.0)[0]
    assert len(alone.ratios) == 0 and math.isnan(alone.resolved)


@pytest.mark.parametrize("axis", [(1.0, 0, 0), (0, 0, 1.0)])
def test_the_mtf_of_a_gaussian_edge_is_a_gaussian(axis):
    """Blurred by sigma along x and y, by twice as much along z."""
    grid, sigma = Grid.centred(64, spacing=1.0), 1.5
    points = voxel_centres(grid)
    r = points.norm(dim=-1)
    along = (points[..., 2] / r.clamp_min(1e-9)).square()
    width = sigma * torch.sqrt(1 + 3 * (along > 0.5).double())
    volume = 5 + 2 * torch.special.ndtr((20 - r) / width)
    own = sigma * (2 if axis[2] else 1)
    mtf = ball_mtf(volume, grid, (0, 0, 0), 40.0, axis)
    exact = torch.exp(-2 * (math.pi * own * mtf.frequencies).square())
    assert (mtf.values - exact).abs().max() < 0.03
    half = math.sqrt(math.log(2) / 2) / math.pi / own
    assert mtf.falls_to(0.5) == pytest.approx(half, rel=0.03)


AXIS = LongAxis(base=(0.0, 0.0, -24.0), apex=(0.0, 0.0, 30.0), septum=(-1.0, 0.0, 0.0))


def ventricle() -> torch.Tensor:
    """A shell whose value at each place is 2 + cos(angle from the anterior wall)."""
    x, y, z = voxel_centres(GRID).unbind(dim=-1)
    beyond = (z - 12).clamp_min(0)
    radius = (x.square() + y.square() + beyond.square()).sqrt()
    # the apex points along +z and the septum along -x: anterior is (-x) x z = +y
    angle = torch.atan2(-x, y)
    return torch.where((radius > 12) & (radius < 22), 2 + torch.cos(angle), 0.0)


def test_the_polar_map_runs_from_anterior_via_the_septum():
    values = polar_map(ventricle(), GRID, AXIS, reach_mm=30.0)
    assert values.shape == (16, 72)
    exact = 2 + torch.cos(torch.deg2rad(5.0 * torch.arange(72))).double()
    assert (values[2:12] - exact).abs().max() < 0.15
    means = segments(values)
    anterior, septal, inferior = 2 + 3 / math.pi, 2 + 3 / math.pi / 2, 2 - 3 / math.pi
    expected = torch.tensor([anterior, septal, 4 - septal, inferior, 4 - septal, septal]).double()
    torch.testing.assert_close(means[:6], expected, atol=0.1, rtol=0)
    torch.testing.assert_close(means[6:12], expected, atol=0.1, rtol=0)
    wide = 2 * math.sqrt(2) / math.pi
    torch.testing.assert_close(
        means[12:16], torch.tensor([2 + wide, 2, 2 - wide, 2]).double(), atol=0.15, rtol=0
    )


def test_a_defect_appears_only_in_its_segments():
    x, y, z = voxel_centres(GRID).unbind(dim=-1)
    angle = torch.rad2deg(torch.atan2(-x, y))
    shell = (ventricle() > 0).double()
    shell[((angle - 60).abs() < 36) & (z < 8)] *= 0.3
    means = segments(polar_map(shell, GRID, AXIS, reach_mm=30.0))
    low = {int(n) + 1 for n in (means < 0.6).nonzero()}
    assert low == {2, 8}
    assert means[[0, 3, 4, 6, 9, 10, 14]].min() > 0.8


def test_bias_and_deviation_match_the_noise_realisations():
    truth = torch.full((1, 1, 4, 4, 4), 10.0)
    random = torch.Generator().manual_seed(0)
    draws = [truth + 0.5 + torch.randn(truth.shape, generator=random) for _ in range(400)]
    figures = repeated(iter(draws), truth)
    stack = torch.stack(draws).double()
    torch.testing.assert_close(figures.mean, stack.mean(dim=0))
    torch.testing.assert_close(figures.deviation, stack.std(dim=0))
    region = figures.within(torch.ones_like(truth, dtype=torch.bool))
    assert region.mean_bias == pytest.approx(0.05, abs=1e-3)
    assert region.bias == pytest.approx(0.05, abs=1e-3)
    assert region.deviation == pytest.approx(0.1, rel=0.02)
    # without a bias, few draws of much noise show none
    even = repeated([truth + d for d in (-1, 1)], truth)
    assert even.within(torch.ones_like(truth, dtype=torch.bool)).bias == 0.0


def test_metrics_of_inconsistent_input_are_refused():
    """Figures of merit refuse a volume of another grid, masks without voxels, a ratio of one, balls
    and phantoms outside the grid, and a single noise draw.
    """
    volume, none = torch.ones(GRID.shape), torch.zeros(GRID.shape, dtype=torch.bool)
    ball = torch.zeros(1, 3), torch.tensor([10.0]), torch.zeros(2, 3)
    for act, message in (
        (lambda: ball_means(volume[1:], GRID, ball[0], 9.0), "shape"),
        (lambda: ball_means(volume, GRID, torch.tensor([[36.0, 0, 0]]), 9.0), "inside the grid"),
        (lambda: sphere_recovery(volume, GRID, *ball, ratio=1.0), "ratio"),
        (lambda: count_bias(volume, volume, none), "mask"),
        (lambda: count_bias(volume, 0 * volume, ~none), "true counts"),
        (lambda: valley_to_peak(volume, GRID, radius=60.0), "inside the grid"),
        (lambda: ball_mtf(volume, GRID, (0, 0, 0), 4.0, (1, 0, 0)), "8 voxels"),
        (lambda: ball_mtf(volume, GRID, (0, 0, 0), 60.0, (0, 0, 0)), "axis"),
        (lambda: polar_map(volume, GRID, AXIS._replace(septum=(0, 0, 1.0)), 30.0), "septum"),
        (lambda: polar_map(volume, GRID, AXIS, 30.0, angles=50), "multiple of 12"),
        (lambda: repeated([volume], volume), "two noise draws"),
        (lambda: repeated([volume, volume * torch.nan], volume), "finite volumes"),
    ):
        with pytest.raises(ValueError, match=message):
            act()


@pytest.mark.parametrize("nudge", [1e-13, -1e-13, 1e-10, -1e-10])
def test_rounding_does_not_decide_bins_and_samples(nudge):
    """Of edges between voxels, and of rays that whole steps fill. Also tried: voxels of 0.1 to
    4 mm, and planes of three slopes.
    """
    grid = Grid.centred(48, spacing=1.0)
    affine = grid.affine.clone()
    affine[:3] *= 1 + nudge
    normal = torch.tensor([1.0, 0.1, 0.0]).double()
    plane = torch.sigmoid(voxel_centres(grid) @ normal / 0.7)
    ball = torch.sigmoid((13 - distance(grid)) / 0.7)
    for one, other in (
        (((0.0, 0, 0), normal, 12.0), ((nudge, nudge, 0), normal, 12.0 * (1 + nudge))),
        (((0.0, 0, 0), normal, 12.0), ((0, 0, nudge), normal, 12.0 * (1 - nudge))),
    ):
        found = plane_mtf(plane, grid, *other).values
        torch.testing.assert_close(found, plane_mtf(plane, grid, *one).values)
    along = ball_mtf(ball, grid, (0, 0, 0), 26.0, (0, 0, 1)).values
    near = ball_mtf(ball, grid, (0, 0, 0), 26.0 * (1 + nudge), (0, 0, 1)).values
    torch.testing.assert_close(near, along)
    wall = torch.exp(-((distance(grid) - 5).square() / 0.64))
    axis = LongAxis((0.0, 0, 6), (0.0, 0, -6), (1.0, 0, 0))
    exact = polar_map(wall, grid, axis, 10.0)
    torch.testing.assert_close(polar_map(wall, grid, axis, 10.0 * (1 + nudge)), exact)
    torch.testing.assert_close(polar_map(wall, Grid(grid.shape, affine), axis, 10.0), exact)
