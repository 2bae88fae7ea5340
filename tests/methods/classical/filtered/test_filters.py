"""The ramp filter in space and in frequency."""

import math

import pytest
import torch

from mvrecon.methods.classical.fdk import (
    WINDOWS,
    filter_rows,
    padded_length,
    ramp_response,
)


def test_filtering_is_the_convolution_with_the_sampled_ramp():
    """Kak and Slaney, eq. 61, without any wrap around the ends of a row."""
    torch.manual_seed(0)
    row = torch.randn(3, 17, dtype=torch.float64)
    n = torch.arange(17)
    apart = (n[:, None] - n).abs()
    ramp = torch.where(apart % 2 == 1, -1 / (math.pi * apart.clamp_min(1)) ** 2, 0.0).double()
    ramp.fill_diagonal_(0.25)
    assert torch.allclose(filter_rows(row, ramp_response(17)), row @ ramp, atol=1e-14)


@pytest.mark.parametrize("name", WINDOWS)
@pytest.mark.parametrize("cutoff", [1.0, 0.5])
def test_windowed_rows_are_convolved_with_the_transform_of_the_windowed_ramp(name, cutoff):
    """The integral of |f| W(f) cos(2 pi f n) by the midpoint rule; rows of any length have one
    kernel, though that of a sharp band limit decays slowly, so a row with zeros at its ends too.
    """
    torch.manual_seed(0)
    row = torch.randn(3, 17, dtype=torch.float64)
    f = (torch.arange(20_000, dtype=torch.float64) + 0.5) / 40_000 * cutoff
    ramp = f * WINDOWS[name](2 * f / cutoff)
    n = torch.arange(17)
    kernel = (ramp * torch.cos(2 * math.pi * f * n[:, None])).sum(dim=1) * cutoff / 20_000
    filtered = filter_rows(row, ramp_response(17, name, cutoff))
    assert torch.allclose(filtered, row @ kernel[(n[:, None] - n).abs()], atol=1e-4)
    longer = filter_rows(torch.nn.functional.pad(row, (20, 30)), ramp_response(67, name, cutoff))
    assert torch.allclose(longer[:, 20:37], filtered, atol=1e-12)


def test_windows_only_lower_the_ramp_and_end_at_the_band_limit():
    ramp = ramp_response(200)
    f = torch.linspace(0, 0.5, len(ramp), dtype=torch.float64)
    assert ((ramp - f).abs() < 1.1 / len(ramp)).all()
    for name in WINDOWS:
        response = ramp_response(200, name)
        assert (response <= ramp + 0.5 / len(ramp)).all()
        low = (f > 0.005) & (f < 0.02)
        assert ((response / ramp)[low] > 0.97).all()
    response = ramp_response(200, "hann", 0.5)
    assert (response[f > 0.26].abs() < 1e-4).all() and response[f < 0.24].all()


def test_the_period_is_at_least_twice_the_row_with_small_prime_factors():
    for columns in (1, 2, 127, 500, 1025):
        length = padded_length(columns)
        rest = length
        for prime in (2, 3, 5):
            while rest % prime == 0:
                rest //= prime
        assert length >= 2 * columns and length % 2 == 0 and rest == 1


@pytest.mark.parametrize(
    ("filter", "cutoff", "message"),
    [("ramlak", 1.0, "Known: ram-lak"), ("hann", 0.0, "got 0.0"), ("hann", 1.5, "in \\(0, 1\\]")],
)
def test_an_unknown_filter_or_band_limit_is_refused(filter, cutoff, message):
    """An unknown filter, or a band limit outside (0, 1], is refused with the expected values."""
    with pytest.raises(ValueError, match=message):
        ramp_response(8, filter, cutoff)
