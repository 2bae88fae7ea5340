"""Counts in parts, scattered and decaying: expectations that hold exactly."""

import math

import pytest
import torch

from mvrecon.data.acquisition.detector import Acquisition, blurred, detected
from mvrecon.geometry.cameras.rigs import dcspect80
from mvrecon.geometry.grid import Grid, voxel_centres
from mvrecon.methods.classical.mlem import mlem, osem
from mvrecon_spect.counts import decay_factors, decaying, thinned
from mvrecon_spect.projector import Spect
from mvrecon_spect.scatter import blurred_share, triple_energy_window

RIG = dcspect80(pixels=[12, 12])[torch.arange(0, 80, 10)]
GRID = Grid.centred(8, spacing=12.0)


def primaries() -> torch.Tensor:
    random = torch.Generator().manual_seed(0)
    return 50 * torch.rand(1, 1, 8, 12, 12, dtype=torch.float64, generator=random)


def rng() -> torch.Generator:
    return torch.Generator().manual_seed(1)


def test_halves_are_independent_poisson_numbers_that_sum_to_the_counts():
    counts = torch.poisson(torch.full((200_000,), 6.0, dtype=torch.float64), generator=rng())
    one, other = thinned(counts, [0.5, 0.5], rng())
    assert torch.equal(one + other, counts)
    table = torch.cov(torch.stack([one, other]))
    # variance is the mean, and a covariance of whole and part would be 3
    torch.testing.assert_close(table, 3.0 * torch.eye(2).double(), rtol=0, atol=0.05)
    few, some = thinned(counts, [0.1, 0.3], rng())
    assert few.mean().item() == pytest.approx(0.6, abs=0.01)
    assert some.mean().item() == pytest.approx(1.8, abs=0.02)
    assert (few + some <= counts).all()


def test_a_scatter_that_is_linear_in_energy_is_what_three_windows_tell():
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


def test_a_share_of_blurred_primaries_is_what_the_acquisition_adds():
    primary = primaries()
    settings = Acquisition(scatter=0.3, scatter_mm=15.0)
    total = detected(primary[0], settings, RIG, rng())[None]
    scatter = blurred_share(total, 0.3, 15.0, RIG, iterations=40)
    torch.testing.assert_close(total - scatter, primary, rtol=1e-9, atol=1e-9)
    rough = blurred_share(total, 0.3, 15.0, RIG)
    assert (rough - scatter).norm() < 1e-4 * scatter.norm()
    assert not blurred_share(total, 0.0, 15.0, RIG).any()


def test_decay_is_the_mean_of_the_exponential():
    factors = decay_factors([0.0, 3600.0, 0.0], [1e-3, 7200.0, 1e9], 3600.0)
    k = math.log(2) / 3600
    mean = (0.5 - 0.125) / (k * 7200)
    torch.testing.assert_close(factors, torch.tensor([1.0, mean, 1 / (k * 1e9)]).double())


def test_decay_in_the_operator_gives_the_activity_at_time_zero():
    A = Spect(GRID, RIG, diameter_mm=8.0)
    factors = decay_factors([600.0 * n for n in range(8)], [600.0] * 8, 3600.0)
    B = decaying(A, factors)
    x = torch.zeros(1, 1, 8, 8, 8, dtype=torch.float64)
    x[..., 2:6, 3:6, 2:7] = 5.0
    torch.testing.assert_close(B(x), A(x) * factors[:, None, None])
    y = torch.rand_like(A(x))
    assert (B(x) * y).sum().item() == pytest.approx((x * B.T(y)).sum().item(), rel=1e-12)
    for solved in (mlem(B, B(x), 2, start=x), mlem(B, B(x), 2, start=x, subsets=4)):
        torch.testing.assert_close(solved, x)


def test_counts_windows_and_shares_that_cannot_be_are_refused():
    """Scatter, thinning and decay refuse counts that are negative, NaN or not whole, shares of more
    than all, and widths or times that are not positive.
    """
    y = primaries().round()
    for act, message in (
        (lambda: thinned(y + 0.5, [0.5], rng()), "whole"),
        (lambda: thinned(-y, [0.5], rng()), "not negative"),
        (lambda: thinned(y, [0.7, 0.7], rng()), "sum to 1"),
        (lambda: triple_energy_window(y, y, (3, 0, 3)), "positive window"),
        (lambda: triple_energy_window(y * torch.nan, y, (3, 28, 3)), "finite"),
        (lambda: triple_energy_window(y, y[..., 1:], (3, 28, 3)), "one shape"),
        (lambda: triple_energy_window(y, y, (3, 28, 3), None, 5.0), "cameras"),
        (lambda: blurred_share(y, 1.0, 15.0, RIG), r"\[0, 1\)"),
        (lambda: decay_factors([0.0], [0.0], 3600.0), "positive duration"),
        (lambda: decaying(Spect(GRID, RIG), torch.ones(3)), "each of 8 views"),
    ):
        with pytest.raises(ValueError, match=message):
            act()


def test_ordered_subsets_whose_rays_miss_most_voxels_add_no_counts():
    """1000 counts, 20 subsets of 4 views, rays five voxels apart: OSEM's own step adds 80 %."""
    grid = Grid.centred(24, spacing=4.0)
    A = Spect(grid, dcspect80(pixels=8), rays_per_pixel=1)
    ball = (voxel_centres(grid).norm(dim=-1) < 36).float()[None, None]
    views = A(ball)
    noise = torch.Generator().manual_seed(0)
    counts = torch.poisson(views * (1e3 / views.sum()), generator=noise)
    x = osem(A, counts, 3, 20)
    explained = (A.T(torch.ones_like(counts)) * x).sum() / counts.sum()
    assert explained.item() == pytest.approx(1, abs=0.05)
