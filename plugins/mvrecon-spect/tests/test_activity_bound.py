"""Empty bricks from counts: false removals and their probability."""

import math

import pytest
import torch
from torch.nn.functional import avg_pool3d

from mvrecon.data.scenes.solids import Phantom
from mvrecon.geometry.cameras.rigs import dome
from mvrecon.geometry.grid import Grid
from mvrecon.operators.visual_hull.footprints import prints_of, summed_area_tables
from mvrecon.operators.visual_hull.hull import expand, visual_hull
from mvrecon_spect.methods import activity_bound as module
from mvrecon_spect.methods.activity_bound import (
    activity_bound,
    brick_sensitivity,
    poisson_bound,
    support_of_counts,
    view_sets,
)
from tests.operators.visual_hull.cases import World, operator

#: Half the 1 - delta quantiles of chi^2 with 2 n + 2 degrees of freedom, by another implementation.
KNOWN = {
    (1, 0.05): 4.743864518390579,
    (1, 1e-6): 16.68842079085992,
    (5, 1e-3): 16.454745203680105,
    (30, 1e-6): 64.97431844528347,
    (1000, 1e-10): 1215.6000255831566,
    (100000, 0.05): 100521.71888230444,
}


@pytest.mark.parametrize("delta", [0.9, 5e-2, 1e-3, 1e-6, 1e-12])
def test_zero_counts_bound_the_mean_by_minus_log_delta(delta: float):
    assert poisson_bound(torch.tensor(0.0), delta).item() == pytest.approx(
        -math.log(delta), rel=1e-9
    )


@pytest.mark.parametrize(("n", "delta"), KNOWN)
def test_the_bound_is_the_quantile_of_chi_squared(n: int, delta: float):
    assert poisson_bound(torch.tensor([float(n)]), delta).item() == pytest.approx(
        KNOWN[n, delta], rel=1e-9
    )


@pytest.mark.parametrize("delta", [0.05, 1e-4])
def test_the_bound_is_below_the_mean_with_at_most_its_probability(delta: float):
    """Summed over all counts, for any mean; and with all of it for means just above a bound."""
    n = torch.arange(200, dtype=torch.float64)
    bounds = poisson_bound(n, delta)
    means = torch.cat(
        [torch.linspace(0.01, 80, 400, dtype=torch.float64), bounds[:20] * (1 + 1e-6)]
    )[:, None]
    below = torch.where(
        bounds < means, (n * means.log() - means - (n + 1).lgamma()).exp(), 0.0
    ).sum(dim=1)
    assert (below <= delta).all()
    assert below[400:].tolist() == pytest.approx([delta] * 20, rel=1e-3)


def test_the_family_of_tests_is_every_view_groups_of_ten_and_all():
    for count, tests in ((1, 1), (7, 8), (10, 11), (20, 23), (80, 89), (81, 90)):
        sets = view_sets(count)  # the last of 81 views is a group of its own
        assert len(sets) == tests
        assert {tuple(row) for row in torch.eye(count).tolist()} <= {
            tuple(row) for row in sets.tolist()
        }
        assert sets.sum(dim=1).max() == count
        assert sets.sum().item() == (count == 1 or 2 + (count > 10)) * count - (count == 81)


def test_the_sensitivity_of_a_brick_is_the_sum_over_its_voxels():
    ones = torch.arange(1.0, 3.0)[:, None, None, None].expand(2, 5, 4, 7)
    pooled = brick_sensitivity(ones, 4)
    assert pooled.shape == (2, 2, 1, 2)
    assert pooled[1].flatten().tolist() == [2.0 * n for n in (64, 48, 16, 12)]


def emission() -> tuple[World, torch.Tensor]:
    """Twelve pinholes about a grid of 4^3 bricks, and what a unit of activity in each brick sends
    to each view.
    """
    grid = Grid.centred((12, 12, 12), 1.0)
    rig = dome(12, 30.0, 20.0, 150.0, {"pixels": [16, 16], "pixel_mm": 0.8})
    world = World(grid, rig, Phantom(()))
    ones = torch.eye(12, dtype=torch.float64)[:, None, :, None, None].expand(-1, -1, -1, 16, 16)
    return world, operator(world).T(ones)[:, 0]


def test_an_active_brick_is_removed_with_at_most_the_stated_probability(monkeypatch):
    """1000 draws of Poisson counts. Four bricks apart, at the tolerance: nothing else adds to their
    counts.
    """
    rng, tolerance, delta = torch.Generator().manual_seed(0), 0.2, 0.05
    world, back = emission()
    active = torch.zeros(1, 4, 4, 4, dtype=torch.bool)
    active[0, [0, 3, 0, 3], [0, 3, 3, 0], [0, 0, 3, 3]] = True
    active = expand(active, 3, world.grid.shape)
    mean = operator(world)(tolerance * active.double())
    counts = torch.poisson(mean.expand(1000, -1, -1, -1, -1), generator=rng)

    def lost(stays: torch.Tensor) -> float:
        return (active & ~stays).flatten(1).any(dim=1).double().mean().item()

    rig, terms = world.cameras, (brick_sensitivity(back, 3), tolerance * (1 - 1e-9), delta)
    stays = support_of_counts(counts, rig, world.grid, *terms, brick=3)
    assert lost(stays) <= delta
    assert stays.float().mean() < 0.75
    # what would not do: all of delta for every test, or one view without a count as a proof
    monkeypatch.setattr(module, "poisson_bound", lambda n, share: poisson_bound(n, delta))
    assert lost(support_of_counts(counts, rig, world.grid, *terms, brick=3)) > delta
    assert lost(expand(visual_hull(counts, rig, world.grid, 3), 3, world.grid.shape)) > delta


def test_with_enough_counts_empty_bricks_are_found_and_bounds_hold():
    rng = torch.Generator().manual_seed(1)
    world, back = emission()
    volume = torch.zeros(1, 1, 12, 12, 12, dtype=torch.float64)
    volume[..., 3:6, 3:6, 3:9] = 1.0
    counts = torch.poisson(50 * operator(world)(volume), generator=rng)
    sensitivity = brick_sensitivity(50 * back, 3)
    bound = activity_bound(counts, world.cameras, world.grid, 3, sensitivity)
    truth = avg_pool3d(volume, 3)[:, 0]
    assert (bound > truth).all()
    stays = support_of_counts(counts, world.cameras, world.grid, sensitivity, 0.05, brick=3)
    assert stays[volume > 0].all()
    assert stays.float().mean() < 0.5


def test_counts_in_a_brick_are_exact_beyond_32_bits():
    world, _ = emission()
    counts = torch.arange(12 * 16 * 16).reshape(1, 12, 16, 16)
    prints, part = prints_of(world.cameras, world.grid, 0.0), range(5, 60)

    def sums(views: torch.Tensor) -> torch.Tensor:
        return module._counted(summed_area_tables(views), prints, 3, world.grid, part)

    few = sums(counts)
    assert few.shape == (1, 12, len(part)) and few.max() > 0
    assert torch.equal(sums(2**33 * counts), 2**33 * few)


def test_bricks_that_no_view_is_sensitive_to_are_not_bounded():
    world, back = emission()
    sensitivity = brick_sensitivity(back, 3)
    sensitivity[:, 1, 2, 3] = 0
    bound = activity_bound(torch.zeros(1, 1, 12, 16, 16), world.cameras, world.grid, 3, sensitivity)
    assert bound[0, 1, 2, 3] == torch.inf
    assert bound.isfinite().sum() == 63
    # of no counts at all the tightest bound is that of all views: -ln of delta's share over all
    # that they expect
    expected = -math.log(1e-3 / (64 * 15)) / sensitivity.sum(dim=0)
    assert torch.allclose(bound[0], expected)


def test_counts_must_be_integers_and_match_the_sensitivity():
    world, back = emission()
    good, counts = brick_sensitivity(back, 3), torch.zeros(1, 1, 12, 16, 16)
    for bad in (counts + 0.5, counts - 1):
        with pytest.raises(ValueError, match="whole numbers from 0"):
            activity_bound(bad, world.cameras, world.grid, 3, good)
    with pytest.raises(ValueError, match=r"\(12, 4, 4, 4\) bricks"):
        activity_bound(counts, world.cameras, world.grid, 3, good[:, 1:])
    with pytest.raises(ValueError, match="negative or NaN"):
        activity_bound(counts, world.cameras, world.grid, 3, good - good.max())
    with pytest.raises(ValueError, match="between 0 and 1"):
        activity_bound(counts, world.cameras, world.grid, 3, good, 1.0)
    with pytest.raises(ValueError, match="positive tolerance"):
        support_of_counts(counts, world.cameras, world.grid, good, 0.0, brick=3)
