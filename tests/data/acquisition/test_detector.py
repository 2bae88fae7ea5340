"""The detector: conserved quantities, noise statistics, and validation of options."""

import math
import re

import pytest
import torch

from mvrecon.core.numbers import generator
from mvrecon.data.acquisition.detector import FWHM_PER_SIGMA, Acquisition, blurred, detected
from mvrecon.geometry.cameras.rigs import parallel

RIG = parallel(2, {"pixels": [41, 61], "pixel_mm": [0.5, 0.4]}, 100.0)
FLAT = torch.full((1, 2, 41, 61), 2.0)


def made(views, seed=0, **options):
    return detected(views, Acquisition(**options), RIG, generator(0, seed))


def test_an_ideal_detector_changes_no_bit():
    assert made(FLAT) is FLAT


def test_blur_keeps_a_uniform_view_and_the_sum_of_a_point():
    assert torch.allclose(blurred(FLAT.double(), 3.0, RIG), FLAT.double(), rtol=1e-12)
    point = torch.zeros(1, 2, 41, 61, dtype=torch.float64)
    point[..., 20, 30] = 1.0
    assert float(blurred(point, 2.0, RIG)[0, 0].sum()) == pytest.approx(1.0, abs=1e-6)


def test_the_blur_of_a_point_has_the_stated_width_in_mm():
    """Its variance along both axes is that of the Gaussian and of a pixel, a box: pitch^2 / 12."""
    point = torch.zeros(1, 2, 41, 61, dtype=torch.float64)
    point[..., 20, 30] = 1.0
    image = blurred(point, 3.0, RIG)[0, 1]
    for axis, pitch, count in ((1, 0.4, 61), (0, 0.5, 41)):
        x = (torch.arange(count, dtype=torch.float64) - (count - 1) / 2) * pitch
        variance = float((image.sum(dim=1 - axis) * x**2).sum())
        assert variance == pytest.approx((3.0 / FWHM_PER_SIGMA) ** 2 + pitch**2 / 12, rel=1e-3)


def test_photons_have_poisson_variance():
    """Of y = -log(N / I0) with N of mean I0 exp(-y): variance exp(y) / I0, mean y."""
    noise = made(FLAT, photons=1e4) - FLAT
    expected = math.exp(2.0) / 1e4
    assert float(noise.var()) == pytest.approx(expected, rel=0.06)
    assert abs(float(noise.mean())) < 4 * math.sqrt(expected / noise.numel()) + expected


def test_counts_are_integers_that_keep_sum_and_unit():
    views = torch.rand(1, 2, 41, 61, generator=torch.Generator().manual_seed(1)) * 1e-4
    measured = made(views, counts=2e5)
    numbers = measured.double() * 2e5 / float(views.double().sum())
    assert (numbers - numbers.round()).abs().max() < 1e-3
    assert float(numbers.sum()) == pytest.approx(2e5, abs=5 * math.sqrt(2e5))


def test_electronic_noise_has_the_specified_standard_deviation_and_unit():
    assert float((made(FLAT, noise=0.3) - FLAT).std()) == pytest.approx(0.3, rel=0.03)
    intensity = torch.exp(-made(FLAT, photons=1e9, noise=1e6)) * 1e9
    assert float(intensity.double().std()) == pytest.approx(1e6, rel=0.03)


def test_scatter_is_a_fraction_of_the_primary_and_zero_in_air():
    assert torch.allclose(made(FLAT, scatter=0.1), 1.1 * FLAT)
    lower = made(FLAT, scatter=0.1, photons=math.inf)
    assert torch.allclose(lower, FLAT - math.log1p(0.1 * 2.0))
    air = torch.zeros_like(FLAT)
    assert torch.equal(made(air, scatter=0.1, photons=math.inf), air)


def test_a_pixel_without_photons_reads_half_a_photon_and_is_reported():
    with pytest.warns(RuntimeWarning, match=r"less than one photon at photons=100: .*scene.value"):
        measured = made(FLAT * 20, photons=100.0)
    assert torch.allclose(measured, torch.full_like(FLAT, math.log(200.0)))


def test_zero_emission_remains_zero():
    assert not made(torch.zeros_like(FLAT), counts=1e3).any()


@pytest.mark.parametrize(
    ("options", "error", "message"),
    [
        ({"photons": 1e4, "counts": 1e4}, ValueError, "photons .* or counts"),
        ({"photons": 0.0}, ValueError, "acquisition.photons as a positive number, got 0"),
        ({"photons": math.inf, "noise": 1.0}, ValueError, "photons must be finite"),
        ({"counts": math.nan}, ValueError, "acquisition.counts as a positive number, got nan"),
        ({"fine": 1}, ValueError, "acquisition.fine as a whole number of at least 2, got 1"),
        ({"blur_mm": -1.0}, ValueError, "acquisition.blur_mm as a number of at least 0"),
        ({"noise": "much"}, TypeError, "acquisition.noise as a number, got 'much'"),
        ({"photon": 1e4}, TypeError, "no option 'photon'; did you mean 'photons'"),
    ],
)
def test_invalid_acquisition_settings_are_refused(options, error, message):
    """Photons, counts, blur or noise without a meaning are refused by their names."""
    with pytest.raises(error, match=message):
        Acquisition.of(options)


def test_negative_views_are_refused_as_counts():
    """Counts of views below zero are refused, not drawn from a clamped mean."""
    with pytest.raises(ValueError, match=re.escape("Counts need views of at least 0, got -2")):
        made(-FLAT, counts=1e3)
