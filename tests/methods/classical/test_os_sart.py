"""Ordered subsets: their order, the metric in which no step goes astray, and the limit."""

import math

import pytest
import torch

from mvrecon.methods.classical.sirt import os_sart, sirt
from mvrecon.operators.selection import distant_order, ordered_subsets, usual_subsets
from tests.methods.classical.methods import Dense, gap, tabulated, truth


@pytest.mark.parametrize("count", [1, 2, 3, 4, 5, 6, 7, 12, 13, 20, 30, 64])
def test_the_subset_order_is_complete_with_distant_successors(count):
    order = distant_order(count)
    assert sorted(order) == list(range(count)) and 1 <= usual_subsets(count) <= count
    steps = [(b - a) % count for a, b in zip(order, order[1:], strict=False)]
    if count > 4:  # on a circle of subsets
        assert min(min(s, count - s) for s in steps) >= max(2, count // 3 - 1)


def test_one_subset_is_sirt():
    A = tabulated()
    y = A(truth(A))
    assert gap(os_sart(A, y, 5, subsets=1), sirt(A, y, 5)) < 1e-12


@pytest.mark.parametrize("relaxation", [0.3, 1.0, 1.9])
def test_no_iteration_increases_the_distance_from_the_solution(relaxation):
    """For consistent views, in the norm of C^-1, for any subsets and relaxation."""
    A = Dense()
    x = truth(A)
    rows = A.matrix.reshape(6, 35, 120)
    sums = torch.stack([rows[list(views)].sum(dim=(0, 1)) for views in ordered_subsets(6, 3)])
    column = torch.maximum(sums.mean(dim=0), relaxation * sums.amax(dim=0) / 1.9)
    column, far = column.reshape(A.domain_shape), []

    def monitor(iterate):
        far.append((column * (iterate.volume - x).square()).sum().item())

    os_sart(A, A(x), 20, subsets=3, relaxation=relaxation, monitor=monitor)
    assert all(later < earlier for earlier, later in zip(far, far[1:], strict=False))


def test_with_decreasing_relaxation_noisy_views_converge_to_least_squares():
    torch.manual_seed(0)
    A = Dense()
    y = A(truth(A)) + torch.randn(1, 1, *A.range_shape, dtype=torch.float64)
    options = {"subsets": 3, "nonnegative": False}
    least = sirt(A, y, 3000, nonnegative=False, momentum=True)
    start = least + 0.01 * least.mean()
    cycle = os_sart(A, y, 100, **options, start=start)
    limit = os_sart(A, y, 400, **options, start=start, reduction=0.985)
    assert gap(limit, least) < 0.4 * gap(cycle, least)


@pytest.mark.parametrize(
    "options",
    [{"relaxation": 0.0}, {"relaxation": 2.0}, {"relaxation": math.nan}, {"reduction": 1.1}],
)
def test_a_relaxation_that_does_not_converge_is_refused(options):
    """OS-SART refuses a relaxation or its reduction where no theory lets it converge."""
    A = Dense()
    with pytest.raises(ValueError, match="0 < relaxation < 2"):
        os_sart(A, A(truth(A)), **options)
