"""Counts in parts, and few counts in ordered subsets: expectations that hold exactly."""

import pytest
import torch

from mvrecon.geometry.cameras.rigs import dcspect80
from mvrecon.geometry.grid import Grid, voxel_centres
from mvrecon.methods.classical.mlem import osem
from mvrecon_spect.methods.counts import thinned
from mvrecon_spect.operators.projector import Spect


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


def test_invalid_counts_and_shares_are_refused():
    """Thinning refuses counts that are negative or not whole, and shares of more than all."""
    y = torch.arange(24.0)
    for act, message in (
        (lambda: thinned(y + 0.5, [0.5], rng()), "whole"),
        (lambda: thinned(-y, [0.5], rng()), "not negative"),
        (lambda: thinned(y, [0.7, 0.7], rng()), "sum to 1"),
    ):
        with pytest.raises(ValueError, match=message):
            act()


def test_ordered_subsets_whose_rays_miss_most_voxels_add_no_counts():
    """1000 counts, 20 subsets of 4 views, rays five voxels apart: OSEM's own step adds 80 %."""
    grid = Grid.centred(24, spacing=4.0)
    A = Spect(grid, dcspect80(pixels=8))
    ball = (voxel_centres(grid).norm(dim=-1) < 36).float()[None, None]
    views = A(ball)
    noise = torch.Generator().manual_seed(0)
    counts = torch.poisson(views * (1e3 / views.sum()), generator=noise)
    x = osem(A, counts, 3, 20)
    explained = (A.T(torch.ones_like(counts)) * x).sum() / counts.sum()
    assert explained.item() == pytest.approx(1, abs=0.05)
