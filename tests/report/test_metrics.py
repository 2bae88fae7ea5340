"""Figures of merit against values computed by hand."""

import math

import numpy as np
import pytest
import torch
from torchmetrics.functional.image import structural_similarity_index_measure

from mvrecon.core.machine import peak_since, restarted_peak
from mvrecon.core.parts import METRICS
from mvrecon.report.metrics import (
    Metric,
    case_metrics,
    declared,
    nrmse,
    psnr,
    psnr_inside,
    ssim_map,
    view_nrmse,
    volume_metrics,
)
from mvrecon.report.quality import coverage, per_view_spread


def case(shape=(1, 8, 9, 10)):
    truth = torch.rand(shape, generator=torch.Generator().manual_seed(0))
    inside = torch.zeros(shape, dtype=torch.bool)
    inside[:, 2:6, 3:7, 2:9] = True
    return truth, inside


def test_psnr_of_a_constant_offset_is_twenty_decibels_per_decade():
    truth, inside = case()
    figures = volume_metrics(truth + 0.2, truth, inside, data_range=2.0)
    assert figures["psnr"] == pytest.approx(20.0, abs=1e-4)
    assert figures["psnr_inside"] == pytest.approx(20.0, abs=1e-4)


def test_the_given_data_range_is_used():
    truth, inside = case()
    narrow = volume_metrics(truth + 0.2, truth, inside, data_range=2.0)["psnr"]
    wide = volume_metrics(truth + 0.2, truth, inside, data_range=20.0)["psnr"]
    assert wide - narrow == pytest.approx(20.0, abs=1e-6)


@pytest.mark.parametrize("unit", [1e-150, 1e-30, 1e30, 1e150])
def test_figures_do_not_depend_on_the_unit(unit: float):
    """Range and values times a factor have the same figures, also where the squared range is beyond
    float32 or float64.
    """
    truth, inside = case()
    volume = truth + 0.1 * torch.rand(truth.shape, generator=torch.Generator().manual_seed(5))
    expected = volume_metrics(volume, truth, inside, 1.5)
    scaled = volume_metrics(volume.double() * unit, truth.double() * unit, inside, 1.5 * unit)
    assert scaled == pytest.approx(expected, rel=1e-5)
    same = volume_metrics(truth, truth, inside, 1.5)
    assert same["psnr"] == float("inf") and same["ssim"] == pytest.approx(1)


def test_nrmse_is_the_relative_norm_of_the_error():
    truth, inside = case()
    assert volume_metrics(0.75 * truth, truth, inside, 1.0)["nrmse"] == pytest.approx(
        0.25, abs=1e-6
    )


@pytest.mark.parametrize("scale", [1e-37, 1e-30, 1e-21, 1.0, 1e21, 1e30, 1e38])
def test_nrmse_does_not_depend_on_the_scale(scale):
    """In float32, whose squares overflow at 1e19 and vanish at 1e-23: NRMSE was nan, or 0. Also
    tried: 1e200 in float64.
    """
    truth = torch.rand(8, 8, 8, generator=torch.Generator().manual_seed(0)) + 0.1
    assert math.isclose(nrmse(1.1 * truth * scale, truth * scale), 0.1, rel_tol=1e-5)


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("share", ["one", "all"])
def test_values_that_are_not_finite_have_no_similarity(value, share):
    """SSIM of a volume of NaN was 1, that of a perfect one; a truth with NaN, too."""
    volume = torch.rand(1, 8, 8, 8, generator=torch.Generator().manual_seed(0))
    truth, inside = volume.clone(), torch.ones_like(volume, dtype=torch.bool)
    volume[(0, 0, 0, 0) if share == "one" else ...] = value
    figures = volume_metrics(volume, truth, inside, 1.0)
    assert all(math.isnan(figures[name]) for name in ("psnr", "ssim", "ssim_inside"))
    assert not math.isfinite(figures["nrmse"])


def test_inside_metrics_include_only_the_object():
    truth, inside = case()
    outside = torch.where(inside, truth, truth + 10)
    figures = volume_metrics(outside, truth, inside, 1.0)
    assert figures["nrmse_inside"] == 0 and math.isinf(figures["psnr_inside"])
    assert figures["nrmse"] > 1
    within = torch.where(inside, truth + 0.1, truth)
    share = inside.float().mean().item()
    figures = volume_metrics(within, truth, inside, 1.0)
    assert figures["psnr_inside"] == pytest.approx(20, abs=1e-4)
    assert figures["psnr"] == pytest.approx(20 - 10 * math.log10(share), abs=1e-4)


def test_ssim_of_two_constants_is_its_luminance_term():
    a, b, c1 = 0.3, 0.7, 0.01**2
    shape = (1, 12, 12, 12)
    expected = (2 * a * b + c1) / (a * a + b * b + c1)
    figures = volume_metrics(
        torch.full(shape, a), torch.full(shape, b), torch.ones(shape, dtype=torch.bool), 1.0
    )
    assert figures["ssim"] == pytest.approx(expected, abs=1e-6)
    assert figures["ssim_inside"] == pytest.approx(expected, abs=1e-6)


@pytest.mark.parametrize("shape", [(1, 9, 6, 14), (1, 1, 12, 14)])
def test_ssim_matches_torchmetrics_in_a_hundredth_of_its_memory(shape):
    """The window is applied axis by axis: no voxel has its 1331 surroundings copied."""
    rng = torch.Generator().manual_seed(0)
    a, b = torch.rand(2, *shape, generator=rng, dtype=torch.float64)
    images = [v[None, :, 0] if shape[1] == 1 else v[None] for v in (a, b)]
    expected, local = structural_similarity_index_measure(
        *images, data_range=0.8, return_full_image=True
    )
    similarity = ssim_map(a, b, 0.8)
    assert similarity.mean().item() == pytest.approx(expected.item(), abs=1e-12)
    assert torch.allclose(similarity, local[0].view_as(similarity), atol=1e-12)


def test_figures_of_64_voxels_an_edge_take_a_few_volumes_of_memory():
    a, b = torch.rand(2, 1, 64, 64, 64)
    volume_metrics(a, b, a > 0, 1.0)
    start = restarted_peak()
    volume_metrics(a, b, a > 0, 1.0)
    assert start is None or peak_since(start) < 20 * 8 * 64**3


def test_ssim_inside_is_the_mean_of_the_map_over_the_object():
    truth, _ = case((1, 24, 12, 12))
    near = torch.zeros(truth.shape, dtype=torch.bool)
    near[:, :6] = True
    changed = truth.clone()
    changed[:, 18:] = 0  # farther from `near` than the window reaches
    figures = volume_metrics(changed, truth, near, 1.0)
    assert figures["ssim_inside"] == pytest.approx(1.0, abs=1e-9)
    assert figures["ssim"] < 0.9
    halves = [volume_metrics(changed, truth, mask, 1.0)["ssim_inside"] for mask in (near, ~near)]
    assert 0.25 * halves[0] + 0.75 * halves[1] == pytest.approx(figures["ssim"], abs=1e-9)


def test_a_slice_has_the_ssim_of_an_image():
    truth, inside = case((1, 1, 12, 14))
    figures = volume_metrics(truth + 0.2, truth, inside, 1.0)
    assert figures["psnr"] == pytest.approx(20 * math.log10(5), abs=1e-4)
    a, b, c1 = torch.full_like(truth, 0.3), torch.full_like(truth, 0.7), 0.01**2
    ssim = volume_metrics(a, b, inside, 1.0)["ssim"]
    assert ssim == pytest.approx((2 * 0.3 * 0.7 + c1) / (0.3**2 + 0.7**2 + c1), abs=1e-6)


def test_equal_volumes_are_perfect():
    truth, inside = case()
    figures = volume_metrics(truth, truth, inside, 1.0)
    assert (
        figures["psnr"] == math.inf
        and figures["nrmse"] == 0
        and figures["ssim"] == pytest.approx(1.0)
    )


def test_an_empty_truth_and_an_empty_mask_are_handled():
    truth, inside = case()
    zero, nowhere = torch.zeros_like(truth), torch.zeros_like(inside)
    assert volume_metrics(truth, zero, inside, 1.0)["nrmse"] == math.inf
    assert volume_metrics(zero, zero, inside, 1.0)["nrmse"] == 0
    assert math.isnan(volume_metrics(truth, truth, nowhere, 1.0)["psnr_inside"])


@pytest.mark.parametrize("shape", [(1, 20, 17, 23), (1, 6, 8, 30), (1, 1, 14, 30)])
@pytest.mark.parametrize("corner", ["first", "last", "middle", "single"])
def test_ssim_inside_is_the_mean_of_the_whole_map_over_the_object(shape, corner):
    """It is computed around the object alone; objects at either border, of one voxel, and of a
    slice.
    """
    rng = torch.Generator().manual_seed(0)
    a, b = torch.rand(2, *shape, generator=rng, dtype=torch.float64)
    inside = torch.zeros(shape, dtype=torch.bool)
    at = {"first": slice(None, 2), "last": slice(-2, None), "middle": slice(3, 5)}
    where = at.get(corner, slice(-1, None))
    inside[:, :, where, where] = True
    figures = volume_metrics(a, b, inside, 0.7)
    expected = ssim_map(a, b, 0.7)[inside].mean().item()
    assert figures["ssim_inside"] == pytest.approx(expected, abs=1e-12)


def test_plugins_figures_of_volumes_and_of_views_stand_beside_mvrecons(monkeypatch):
    @Metric(unit="mm^3", column="lost volume", format=".0f")
    def lost(volume, truth, inside, data_range):
        return (volume[inside] == 0).sum()

    @Metric(unit="%", of_views=True)
    def worst(views, measured):
        return 100 * (views - measured).abs().max()

    parts = {**METRICS._parts, "lost": lost, "worst": worst, "plain": lambda *_: 2}
    monkeypatch.setattr(METRICS, "_parts", parts)
    truth, inside = case()
    views = torch.rand(1, 2, 4, 4)
    batch = {"volume": truth[None], "inside": inside[None], "views": views[None]}
    figures = case_metrics(torch.where(inside, 0, truth), views + 0.25, batch, 1.0)
    assert figures["lost"] == inside.sum() and figures["plain"] == 2
    assert figures["worst"] == pytest.approx(25, rel=1e-5) and math.isfinite(figures["psnr"])
    failed = case_metrics(truth * math.nan, views, batch, 1.0)
    assert failed.keys() == figures.keys() and all(map(math.isnan, failed.values()))
    assert declared("lost").heading == "lost volume mm^3" and declared("plain").heading == "plain"
    assert [declared(name).unit for name in ("psnr", "worst", "plain")] == ["dB", "%", ""]
    with pytest.raises(LookupError, match="'psnr' exists already"):
        METRICS.register("psnr")(lost)


def test_view_error_is_relative_over_all_cameras():
    measured = torch.zeros(1, 2, 4, 4)
    measured[0, 0], measured[0, 1] = 3.0, 4.0
    predicted = measured.clone()
    predicted[0, 0] = 0.0
    assert view_nrmse(predicted, measured) == pytest.approx(3 / 5)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"volume": torch.rand(1, 8, 9, 9)}, r"one shape"),
    ],
)
def test_invalid_input_is_reported_with_the_received_value(change, message):
    truth, inside = case()
    arguments = {"volume": truth, "truth": truth, "inside": inside, "data_range": 1.0} | change
    with pytest.raises(ValueError, match=message):
        volume_metrics(**arguments)


@pytest.mark.parametrize(
    "given",
    [0, 0.0, -1.0, -1e300, math.nan, math.inf, -math.inf, 10**400]
    + [None, "1", True, [1.0], 1 + 0j, 1e-300, 5e-324, 1e-8],
)
def test_a_data_range_without_a_right_figure_is_refused(given):
    """Zero, negative, not finite, beyond float64, of another type, and below a millionth of the
    truth: by every function that takes one, also for a failed volume.
    """
    truth, inside = case()
    scene = {"volume": truth[None], "inside": inside[None], "views": torch.ones(1, 1, 2, 3, 3)}
    calls = (
        lambda: volume_metrics(truth, truth, inside, given),
        lambda: ssim_map(truth, truth, given),
        lambda: case_metrics(truth, scene["views"][0], scene, given),
    )
    for call in calls:
        with pytest.raises((TypeError, ValueError), match=r"^data_range: expected .*, got "):
            call()
    if given not in (1e-300, 5e-324, 1e-8):  # these are refused for the truth that they are below
        with pytest.raises((TypeError, ValueError), match=r"^data_range: expected .*, got "):
            case_metrics(truth * math.nan, scene["views"][0], scene, given)
        for figure in (psnr, psnr_inside):
            with pytest.raises((TypeError, ValueError), match=r"^data_range: expected .*, got "):
                figure(truth + 0.2, truth, inside, given)


@pytest.mark.parametrize("given", [1e-5, 1e8, 1e30, 1e150, 1e300, np.float32(2), 3])
def test_a_range_far_from_the_values_has_its_own_figures(given):
    """PSNR is 20 log10(range / RMSE) for any range, whose square float64 may not hold; the wider
    the range, the more alike volumes are. Also of NumPy's and of whole numbers.
    """
    truth, inside = case()
    figures = volume_metrics(truth + 0.2, truth, inside, given)
    expected = 20 * (math.log10(given) - math.log10(0.2))
    assert figures["psnr"] == pytest.approx(expected, abs=1e-4)
    assert figures["psnr_inside"] == pytest.approx(expected, abs=1e-4)
    assert -1 <= figures["ssim"] <= 1 + 1e-12
    if given >= 1e8:
        assert figures["ssim"] == pytest.approx(1, abs=1e-12)


@pytest.mark.parametrize("top", [1e20, 1e200, 1e300])
def test_a_volume_that_has_run_away_has_finite_figures(top):
    """PSNR is that of its closed form, SSIM that of nothing alike."""
    truth, inside = case()
    away = torch.full(truth.shape, top, dtype=torch.float64)
    figures = volume_metrics(away, truth, inside, 1.0)
    assert figures["psnr"] == pytest.approx(-20 * math.log10(top), abs=1e-4)
    assert figures["ssim"] == pytest.approx(0, abs=1e-6)


def test_small_volumes_and_unequal_views_are_refused():
    small = torch.rand(1, 5, 8, 8)
    with pytest.raises(ValueError, match="at least 6"):
        volume_metrics(small, small, small > 0, 1.0)
    with pytest.raises(ValueError, match="measured"):
        view_nrmse(torch.rand(1, 2, 4, 4), torch.rand(1, 3, 4, 4))


def test_intervals_of_laplace_errors_have_their_coverage():
    """68 and 95 % of errors whose sizes differ, if sigma is their standard deviation, within 4
    standard errors; all with an infinite one."""
    rng = torch.Generator().manual_seed(0)
    sigma = torch.rand(40_000, generator=rng) + 0.1
    exponential = torch.empty(2, 40_000).exponential_(math.sqrt(2), generator=rng)
    error = sigma * (exponential[0] - exponential[1])
    assert error.div(sigma).std().item() == pytest.approx(1, abs=0.02)
    assert coverage(error, sigma, 0.68) == pytest.approx(0.68, abs=0.0094)
    assert coverage(error, sigma, 0.95) == pytest.approx(0.95, abs=0.0044)
    assert coverage(error, math.inf * sigma, 0.95) == 1
    assert math.isnan(coverage(error[:0], sigma[:0], 0.68))


def test_the_spread_of_per_view_estimates_is_their_standard_deviation_over_their_mean():
    estimates = torch.tensor([1.0, 3.0, 9.0]).reshape(1, 3, 1, 1, 1, 1)
    weights = torch.tensor([0.5, 0.5, 0.0]).reshape(1, 3, 1, 1, 1, 1)
    assert per_view_spread(estimates, weights) == pytest.approx(0.5)
    assert per_view_spread(0 * estimates, weights) == 0
