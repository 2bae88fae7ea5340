"""Scatter, uniformity, dead time, decay and the post-filter: closed forms and small numpy codes."""

import math

import numpy as np
import pytest
import torch

from mvrecon.data.acquisition.detector import Acquisition, blurred, detected
from mvrecon.geometry.cameras.rigs import dcspect80
from mvrecon.geometry.grid import Grid
from mvrecon.methods.classical.mlem import mlem
from mvrecon_spect.methods.corrections import (
    blurred_share,
    corrected,
    decay_factors,
    dual_energy_window,
    given_scatter,
    live_factors,
    post_filtered,
    triple_energy_window,
    uniformity_factors,
)
from mvrecon_spect.operators.projector import Spect

RIG = dcspect80(pixels=[12, 12])[torch.arange(0, 80, 10)]
GRID = Grid.centred(8, spacing=12.0)


def primaries() -> torch.Tensor:
    random = torch.Generator().manual_seed(0)
    return 50 * torch.rand(1, 1, 8, 12, 12, dtype=torch.float64, generator=random)


def rng() -> torch.Generator:
    return torch.Generator().manual_seed(1)


def test_three_windows_recover_scatter_that_is_linear_in_energy():
    """The trapezium is exact for a line: density 5 - 0.02 E, windows 3, 28 and 3 keV wide."""
    density = lambda kev: 5 - 0.02 * kev  # noqa: E731
    lower, main, upper = (
        width * density(middle) for width, middle in ((3, 125.0), (28, 140.5), (3, 156.0))
    )
    views = torch.ones(1, 1, 8, 12, 12, dtype=torch.float64)
    scatter = triple_energy_window(lower * views, upper * views, (3, 28, 3))
    torch.testing.assert_close(scatter, main * views)
    one = torch.rand_like(views)
    smooth = triple_energy_window(one, None, (3, 28, 3), RIG, 20.0)
    torch.testing.assert_close(smooth[0], blurred(one[0] / 3 * 14, 20.0, RIG))


def test_dual_energy_window_scales_the_lower_window():
    lower = primaries()
    torch.testing.assert_close(dual_energy_window(lower), 0.5 * lower)
    smooth = dual_energy_window(lower, 0.7, RIG, 20.0)
    torch.testing.assert_close(smooth[0], 0.7 * blurred(lower[0], 20.0, RIG))


def test_a_given_map_is_scaled_to_its_fraction_of_each_case():
    shape = primaries().repeat(2, 1, 1, 1, 1)
    counts = torch.stack([shape[0].flip(-1), 7 * shape[0]])
    scatter = given_scatter(shape, counts, 0.3)
    share = scatter.flatten(1).sum(dim=1) / counts.flatten(1).sum(dim=1)
    torch.testing.assert_close(share, torch.full((2,), 0.3).double())
    torch.testing.assert_close(scatter[0] / scatter[0].sum(), shape[0] / shape[0].sum())


def test_given_scatter_as_background_recovers_the_activity():
    """Counts of known activity and scatter: the activity is a fixed point of MLEM."""
    A = Spect(GRID, RIG, diameter_mm=8.0)
    x = torch.zeros(1, 1, 8, 8, 8, dtype=torch.float64)
    x[..., 2:6, 3:6, 2:7] = 5.0
    clean = A(x)
    shape = blurred(clean[0], 30.0, RIG)[None]
    counts = clean + 0.25 * clean.sum() / shape.sum() * shape
    scatter = given_scatter(3 * shape, counts, 0.2)
    torch.testing.assert_close(mlem(A, counts, 2, background=scatter, start=x), x)


def test_blurred_primaries_recover_the_simulated_scatter():
    primary = primaries()
    settings = Acquisition(scatter=0.3, scatter_mm=15.0)
    total = detected(primary[0], settings, RIG, rng())[None]
    scatter = blurred_share(total, 0.3, 15.0, RIG, iterations=40)
    torch.testing.assert_close(total - scatter, primary, rtol=1e-9, atol=1e-9)
    rough = blurred_share(total, 0.3, 15.0, RIG)
    assert (rough - scatter).norm() < 1e-4 * scatter.norm()
    assert not blurred_share(total, 0.0, 15.0, RIG).any()


def test_a_flood_recovers_the_detector_sensitivity():
    pattern = 0.8 + 0.4 * primaries()[0, 0] / 50
    pattern[2, 3, 4] = 0.0
    factors = uniformity_factors(4e4 * pattern)
    array = pattern.numpy()
    expected = array / array.mean(axis=(1, 2), keepdims=True, where=array > 0)
    np.testing.assert_allclose(factors.numpy(), expected, rtol=1e-12)
    assert factors[2, 3, 4] == 0
    # an extrinsic flood, seen through the pinholes
    A = Spect(GRID, RIG, diameter_mm=8.0)
    seen = A(torch.ones(1, 1, 8, 8, 8, dtype=torch.float64))[0, 0]
    gain = pattern * torch.linspace(1, 2, 8).double()[:, None, None]
    extrinsic = uniformity_factors(gain * seen, seen)
    live = seen * (pattern > 0)
    level = (gain * seen).sum(dim=(1, 2), keepdim=True) / live.sum(dim=(1, 2), keepdim=True)
    torch.testing.assert_close(extrinsic[seen > 0], (gain / level)[seen > 0])
    smooth = uniformity_factors(4e4 * pattern, None, RIG, 8.0)
    live = (pattern > 0).double()
    measured, ideal = (live * blurred(one[None], 8.0, RIG)[0] for one in (pattern, live))
    level = measured.sum(dim=(1, 2), keepdim=True) / ideal.sum(dim=(1, 2), keepdim=True)
    torch.testing.assert_close(smooth, (measured / ideal / level).nan_to_num())


def test_a_dead_pixel_changes_no_other_factor():
    """Neither of the pixels around it, which smoothing mixes, nor, by the mean, of all."""
    flood = torch.full((2, 8, 8), 1e4)
    flood[0, 3, 3:6] = 0
    for width in (0.0, 8.0):
        factors = uniformity_factors(flood, None, dcspect80(pixels=8)[[0, 1]], width)
        np.testing.assert_allclose(factors, (flood > 0).double(), rtol=1e-12)


@pytest.mark.parametrize(
    ("start", "duration", "half_life"),
    [(1.7e9, 10, 21624), (-1.7e9, 10, 21624), (math.nan, 1, 9), (0, math.inf, 9), (0, 1, math.inf)],
)
def test_times_of_another_clock_are_refused(start: float, duration: float, half_life: float):
    """A start as seconds since 1970 made every factor zero, and the volume."""
    with pytest.raises(ValueError, match=r"half-li"):
        decay_factors([start], [duration], half_life)


@pytest.mark.parametrize("paralysable", [False, True])
def test_live_time_inverts_the_dead_time_model(paralysable: bool):
    tau = 2e-6
    true = np.array([0.0, 1e-3, 1e3, 1e5, 2.5e5, 4.9e5])  # up to 0.98 of 1 / tau
    measured = true * np.exp(-true * tau) if paralysable else true / (1 + true * tau)
    share = live_factors(measured.tolist(), tau, paralysable).numpy()
    # near 1 / tau the paralysable law is flat: digits of m are lost twice
    np.testing.assert_allclose(measured / share, true, rtol=1e-9)
    exact = np.exp(-true * tau) if paralysable else 1 / (1 + true * tau)
    np.testing.assert_allclose(share, exact, rtol=1e-9)


def test_a_simulated_detector_follows_the_dead_time_model():
    """Events in time, one by one: a detector blind for tau after each count, or each event."""
    random, tau, rate = np.random.default_rng(0), 1e-5, 4e4
    times = np.cumsum(random.exponential(1 / rate, 400_000))
    span = times[-1]
    paralysed = 1 + int((np.diff(times) > tau).sum())
    free, counted = -1.0, 0
    for time in times:
        if time >= free:
            counted, free = counted + 1, time + tau
    for count, model in ((counted, False), (paralysed, True)):
        share = live_factors([count / span], tau, model).item()
        assert count / share == pytest.approx(len(times), rel=5e-3)
        assert share < 0.75


def test_impossible_count_rates_are_refused():
    assert live_factors([0.0, 5.0], 0.0).tolist() == [1, 1]
    assert live_factors([1e3 / math.e * (1 - 1e-12)], 1e-3, True).item() == pytest.approx(
        1 / math.e, rel=1e-5
    )
    for rate, model in ((1001.0, False), (1000.0, False), (368.0, True)):
        with pytest.raises(ValueError, match="m tau"):
            live_factors([rate], 1e-3, model)


def test_decay_is_the_mean_of_the_exponential():
    factors = decay_factors([0.0, 3600.0, 0.0], [1e-3, 7200.0, 1e9], 3600.0)
    k = math.log(2) / 3600
    mean = (0.5 - 0.125) / (k * 7200)
    torch.testing.assert_close(factors, torch.tensor([1.0, mean, 1 / (k * 1e9)]).double())
    later = decay_factors([0.0, 3600.0], [1.0, 60.0], 3600.0, reference_s=7200.0)
    torch.testing.assert_close(later, 4 * decay_factors([0.0, 3600.0], [1.0, 60.0], 3600.0))


def test_decay_in_the_operator_recovers_the_activity_at_time_zero():
    A = Spect(GRID, RIG, diameter_mm=8.0)
    factors = decay_factors([600.0 * n for n in range(8)], [600.0] * 8, 3600.0)
    B = corrected(A, factors)
    x = torch.zeros(1, 1, 8, 8, 8, dtype=torch.float64)
    x[..., 2:6, 3:6, 2:7] = 5.0
    torch.testing.assert_close(B(x), A(x) * factors[:, None, None])
    y = torch.rand_like(A(x))
    assert (B(x) * y).sum().item() == pytest.approx((x * B.T(y)).sum().item(), rel=1e-12)
    for solved in (mlem(B, B(x), 2, start=x), mlem(B, B(x), 2, start=x, subsets=4)):
        torch.testing.assert_close(solved, x)


def test_all_factors_together_recover_the_activity():
    A = Spect(GRID, RIG, diameter_mm=8.0)
    x = torch.zeros(1, 1, 8, 8, 8, dtype=torch.float64)
    x[..., 2:6, 3:6, 2:7] = 5.0
    flood = uniformity_factors(1e4 * (0.8 + 0.4 * primaries()[0, 0] / 50))
    decay = decay_factors([600.0 * n for n in range(8)], [600.0] * 8, 21624.0)
    seen = A(x) * flood * decay[:, None, None]
    rates = seen.sum(dim=(0, 1, 3, 4)) / 600.0
    tau = 0.2 / rates.max().item()
    measured = seen / (1 + rates * tau)[:, None, None]
    live = live_factors((measured.sum(dim=(0, 1, 3, 4)) / 600.0).tolist(), tau)
    B = corrected(A, flood, decay, live)
    torch.testing.assert_close(B(x), measured)
    for solved in (mlem(B, measured, 2, start=x), mlem(B, measured, 2, start=x, subsets=4)):
        torch.testing.assert_close(solved, x)


def test_the_post_filter_is_a_gaussian_in_mm():
    """A point becomes the product of the Gaussian's integrals over voxels of any size."""
    grid = Grid.centred(size=(41, 31, 21), spacing=(1.0, 2.0, 3.0))
    point = torch.zeros(1, 1, *grid.shape, dtype=torch.float64)
    point[0, 0, 10, 15, 20] = 7.0
    found = post_filtered(point, grid, 6.0)[0, 0].numpy()
    sigma = 6.0 / math.sqrt(8 * math.log(2))

    def weights(count: int, pitch: float) -> np.ndarray:
        ends = (np.arange(count + 1) - count / 2) * pitch / (sigma * math.sqrt(2))
        return np.diff([math.erf(end) for end in ends]) / 2

    x, y, z = (weights(n, p) for n, p in zip(grid.size, grid.spacing, strict=True))
    np.testing.assert_allclose(found, 7 * np.einsum("i,j,k->kji", x, y, z), atol=1e-7)
    profile = found[10, 15, 20:]
    half = np.interp(-0.5 * profile[0], -profile, np.arange(21.0))
    assert 2 * half == pytest.approx(6.0, rel=0.02)
    uniform = torch.ones(2, 1, *grid.shape)
    torch.testing.assert_close(post_filtered(uniform, grid, 6.0), uniform)
    assert post_filtered(point, grid, 0.0) is point


def test_invalid_corrections_are_refused():
    """Counts that are negative or NaN, other shapes, and widths, times or shares out of their range
    are refused.
    """
    y = primaries().round()
    A, volume, hot = Spect(GRID, RIG), torch.ones(1, 1, 8, 8, 8), torch.ones(8, 12, 12)
    for act, message in (
        (lambda: triple_energy_window(y, y, (3, 0, 3)), "positive window"),
        (lambda: triple_energy_window(y * torch.nan, y, (3, 28, 3)), "finite"),
        (lambda: triple_energy_window(y, y[..., 1:], (3, 28, 3)), "one shape"),
        (lambda: triple_energy_window(y, y, (3, 28, 3), None, 5.0), "cameras"),
        (lambda: dual_energy_window(-y), "not negative"),
        (lambda: dual_energy_window(y, -0.1), "finite k"),
        (lambda: given_scatter(y, y, 1.0), r"\[0, 1\)"),
        (lambda: given_scatter(y[..., 1:], y, 0.1), "counts' shape"),
        (lambda: given_scatter(0 * y, y, 0.1), "zeros alone"),
        (lambda: given_scatter(-y, y, 0.1), "a map of scatter"),
        (lambda: blurred_share(y, 1.0, 15.0, RIG), r"\[0, 1\)"),
        (lambda: uniformity_factors(-hot), "a flood's counts"),
        (lambda: uniformity_factors(hot, hot[1:]), "one shape"),
        (lambda: uniformity_factors(hot, 0 * hot), "none are expected"),
        (lambda: uniformity_factors(hot * torch.arange(8)[:, None, None]), "every view"),
        (lambda: live_factors([-1.0], 1e-6), "rates"),
        (lambda: live_factors([1.0], -1e-6), "dead time tau of at least 0"),
        (lambda: decay_factors([0.0], [0.0], 3600.0), "positive duration"),
        (lambda: corrected(A, torch.ones(3)), "each of 8 views"),
        (lambda: corrected(A, -hot), "factors that are finite"),
        (lambda: post_filtered(volume, GRID, -1.0), "FWHM"),
        (lambda: post_filtered(volume[..., 1:], GRID, 1.0), "grid's"),
    ):
        with pytest.raises(ValueError, match=message):
            act()
