"""Alignment recovers shifts and gains of views and ignores other differences."""

import math
from dataclasses import replace

import pytest
import torch

from mvrecon.methods.calibration.alignment import (
    Alignment,
    aligned,
    alignment,
    blurred,
    translated,
)
from tests.methods.learned.rig import small_projector


def blobs(sizes=(1, 1, 3, 28, 32)) -> torch.Tensor:
    """Smooth views of a few blobs, well inside the detector."""
    torch.manual_seed(0)
    spots = torch.zeros(sizes)
    spots[..., 9:-9, 9:-9] = torch.rand(spots[..., 9:-9, 9:-9].shape) ** 4
    return blurred(spots, 2.0)


SHIFT = torch.tensor([[[0.6, -0.4], [-1.0, 0.9], [0.0, 0.0]]])
GAIN = torch.tensor([[1.05, 0.96, 1.0]])


def disturbed(views: torch.Tensor) -> torch.Tensor:
    return translated(views, SHIFT) * GAIN[:, None, :, None, None]


def test_a_wave_is_shifted_by_fractions_of_a_pixel():
    place = torch.arange(40, dtype=torch.float64)
    frequency = 2 * math.pi / 8
    wave = torch.cos(frequency * place).expand(1, 1, 1, 6, 40)
    moved = translated(wave, torch.tensor([[[0.3, 0.5]]], dtype=torch.float64))
    expected = torch.cos(frequency * (place + 0.3)).expand_as(wave)
    inner = slice(8, -8)
    torch.testing.assert_close(moved[..., inner], expected[..., inner], rtol=0, atol=6e-3)


def test_whole_pixel_shifts_are_exact_and_keep_a_uniform_view():
    views = torch.rand(1, 1, 1, 10, 12)
    moved = translated(views, torch.tensor([[[1.0, -2.0]]]))
    torch.testing.assert_close(moved[..., 2:, :-1], views[..., :-2, 1:], rtol=0, atol=1e-5)
    level = torch.full((1, 1, 1, 10, 12), 3.0)
    torch.testing.assert_close(translated(level, torch.tensor([[[0.4, -3.7]]])), level)


def test_a_shift_is_that_of_the_detector():
    A = small_projector(n_views=3, size=24, pixels=36)
    volume = torch.zeros(1, 1, 24, 24, 24)
    volume[..., 8:16, 9:14, 10:17] = 1
    volume = torch.nn.functional.avg_pool3d(volume, 5, stride=1, padding=2)
    shifted = type(A)(grid=A.grid, cameras=A.cameras.shifted(SHIFT[0].double()))(volume)
    plain = A(volume)
    error = (translated(plain, SHIFT) - shifted).norm()
    assert error < 0.02 * plain.norm() < 0.3 * (plain - shifted).norm()


def test_shift_gain_and_views_are_recovered():
    expected = blobs()
    views = disturbed(expected)
    by = alignment(views, expected, steps=4)
    torch.testing.assert_close(by.shift_px, SHIFT, rtol=0, atol=0.01)
    torch.testing.assert_close(by.gain, GAIN, rtol=0, atol=2e-3)
    assert (aligned(views, by) - expected).norm() < 0.01 * expected.norm()


def test_pixels_unexplained_by_the_expected_view_are_ignored():
    expected = blobs()
    views = disturbed(expected)
    views[..., 10:15, 10:15] += 0.5 * expected.amax()
    by = alignment(views, expected, steps=4)
    assert (by.shift_px - SHIFT).abs().max() < 0.1 < 0.25 * SHIFT.abs().max()
    plain = alignment(views, expected, weight=torch.zeros_like(views))
    assert not plain.shift_px.any() and plain.shift_error.allclose(torch.ones(()))


def test_the_estimated_error_matches_repeated_noisy_fits():
    expected = blobs((1, 1, 1, 28, 32)).expand(64, 1, 1, 28, 32)
    noise = 0.05 * expected.amax() * torch.randn(64, 1, 1, 28, 32)
    by = alignment(expected + noise, expected)
    spread = by.shift_px.std(dim=0)
    assert (spread < by.shift_error.mean(dim=0)).all()  # errors of pixels count as alike
    assert (by.shift_error.mean(dim=0) < 10 * spread).all()


def test_an_alignment_is_differentiable_in_the_expected_view():
    expected = blobs((1, 1, 1, 28, 32)).double()
    views = translated(expected, torch.tensor([[[1.0, -1.0]]], dtype=torch.float64).expand(1, 3, 2))

    def moved(along: torch.Tensor) -> torch.Tensor:
        return alignment(views, translated(expected, along.expand(1, 3, 2)), steps=4).shift_px

    along = torch.zeros(1, 1, 1, dtype=torch.float64, requires_grad=True)
    (slope,) = torch.autograd.grad(moved(along).sum(), along)
    assert slope.item() == pytest.approx(-6.0, abs=0.05)


def test_alignment_is_scale_invariant_and_zero_for_zero_views():
    expected = blobs()
    one, other = (alignment(a * disturbed(expected), a * expected) for a in (1.0, 2.0**-20))
    torch.testing.assert_close(one.shift_px, other.shift_px)
    empty = torch.zeros_like(expected)
    by = alignment(empty, empty)
    assert not by.shift_px.any() and (by.gain == 1).all()


def test_the_deviation_identifies_wrong_cameras():
    by = Alignment(SHIFT, GAIN, torch.zeros_like(SHIFT), torch.zeros_like(GAIN))
    deviation = by.deviation()
    assert (deviation[0, :2] > 1).all() and deviation[0, 2] == 0


def test_views_of_another_shape_are_refused():
    """Alignment refuses expected views of another shape, and no step."""
    views = blobs()
    for bad in ({"expected": views[..., 1:]}, {"expected": views, "steps": 0}):
        with pytest.raises(ValueError, match="of one shape"):
            alignment(views, **bad)


@pytest.mark.parametrize("level", [0.3, 5.0, 200.0])
def test_aligned_counts_are_non_negative_and_keep_their_sum(level):
    """Sparse and many counts, a single bright pixel, a gain; views with negative values, such as
    noisy line integrals, keep those of the interpolation.
    """
    rng = torch.Generator().manual_seed(0)
    blob = torch.exp(-((torch.arange(32.0) - 16) ** 2) / 20)
    counts = torch.poisson(level * blob[:, None] * blob.expand(1, 1, 4, 32, 32), generator=rng)
    counts[0, 0, 1] = 0
    counts[0, 0, 1, 15, 17] = 1000
    none = Alignment.none(counts)
    shift = torch.tensor([[[0.5, 0.5], [0.4, -0.3], [-1.7, 2.3], [0.0, 0.0]]])
    by = replace(none, shift_px=shift, gain=torch.tensor([[1.0, 1.0, 2.0, 1.0]]))
    got = aligned(counts, by)
    assert got.min() >= 0
    sums = counts.sum(dim=(3, 4)) / by.gain[:, None]
    torch.testing.assert_close(got.sum(dim=(3, 4)), sums, rtol=2e-3, atol=0)
    assert torch.allclose(got[:, :, 3], counts[:, :, 3], atol=1e-4 * counts.max().item())
    assert translated(counts, -shift).min() < 0, "as the interpolation alone does"
    assert aligned(counts - 1, by).min() < -1
