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


def test_the_ramp_is_the_frequency_and_windows_only_lower_it():
    ramp = ramp_response(200)
    f = torch.linspace(0, 0.5, len(ramp), dtype=torch.float64)
    assert ((ramp - f).abs() < 1.1 / len(ramp)).all()
    for name in WINDOWS:
        response = ramp_response(200, name)
        assert (response <= ramp + 1e-15).all() and response[0] == ramp[0]
        low = f < 0.02
        assert (response[low] > 0.98 * ramp[low]).all()


def test_the_band_limit_removes_what_is_above():
    response, f = ramp_response(100, "hann", 0.5), torch.linspace(0, 1, 101)
    assert not response[f > 0.5].any() and response[f < 0.49].all()


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
