"""Likelihoods of counts with total variation: the method ends at the minimum."""

import pytest
import torch

from mvrecon.methods.classical.mlem import mlem, osem
from mvrecon.methods.classical.poisson import PoissonLikelihood
from mvrecon.methods.classical.total_variation import total_variation, voxel_steps
from mvrecon.operators.operator import LinearOperator
from mvrecon.testing import check_method
from mvrecon_spect.methods.tv_map import tv_map
from tests.methods.classical.methods import Dense, counted, gap, projector, scale, tabulated, truth


class Same(LinearOperator):
    """Each voxel has a bin of its own, of this sensitivity."""

    domain_shape = range_shape = (1, 1, 2)

    def forward(self, x):
        return 3.0 * x

    def adjoint(self, y):
        return 3.0 * y


def test_it_keeps_the_contract_of_methods():
    check_method("tv_map", projector(), iterations=4)


@pytest.mark.parametrize("make", [tabulated, Dense])
def test_it_explains_consistent_views(make):
    A = make()
    views = A(truth(A))
    assert gap(A(tv_map(A, views, 300, 1e-5)), views) < 2e-2


def test_the_objective_is_reported_and_decreases_in_each_iteration():
    A, values = tabulated(), {}
    counts = counted(A)
    runs = {
        "mlem": lambda watch: mlem(A, counts, 12, 0.2, monitor=watch),
        "osem": lambda watch: osem(A, counts, 3, 3, 0.2, monitor=watch),
        "tv_map": lambda watch: tv_map(A, counts, 60, 0.05, background=0.2, monitor=watch),
    }
    for name, method in runs.items():
        values[name] = []
        method(lambda iterate, own=values[name]: own.append(iterate.objective.item()))
    assert all(b < a for a, b in zip(values["mlem"], values["mlem"][1:], strict=False))
    assert values["osem"][2] < values["mlem"][2]
    x = tv_map(A, counts, 60, 0.05, background=0.2)
    own = PoissonLikelihood(A, counts, 0.2)(x) + 0.05 * scale(A, counts) * total_variation(
        x, voxel_steps(A)
    ).sum(dim=1)
    assert values["tv_map"][-1] == pytest.approx(own.item(), rel=1e-12)
    assert values["tv_map"][-1] < values["tv_map"][0]


@pytest.mark.parametrize(("weight", "expected"), [(0.1, (50 / 1.1, 20 / 0.9)), (0.8, (35.0, 35.0))])
def test_two_voxels_with_total_variation_have_their_closed_form(weight, expected):
    """1 - y / x +- weight = 0 for the higher and the lower voxel, or their mean."""
    counts = torch.tensor([50.0, 20.0], dtype=torch.float64).reshape(1, 1, 1, 1, 2)
    x = 3.0 * tv_map(Same(), counts, 2000, weight)
    torch.testing.assert_close(x.flatten(), x.new_tensor(expected), rtol=1e-6, atol=0)


def test_total_variation_without_weight_has_the_likelihood_of_mlem():
    A = Dense()
    counts = counted(A)
    L = PoissonLikelihood(A, counts)
    one, other = (L(x).item() for x in (tv_map(A, counts, 2000, 0.0), mlem(A, counts, 3000)))
    assert one <= other + 1e-6 * abs(other)


def test_a_minimum_of_the_total_variation_is_not_improved_by_any_step():
    A = tabulated()
    counts, weight = counted(A), 0.3
    x = tv_map(A, counts, 800, weight)
    L, strength = PoissonLikelihood(A, counts), weight * scale(A, counts)

    def value(volume):
        return (L(volume) + strength * total_variation(volume, voxel_steps(A)).sum(dim=1)).item()

    random = torch.Generator().manual_seed(5)
    for size in (1e-2, 0.1):
        for _ in range(5):
            step = torch.randn(x.shape, dtype=x.dtype, generator=random)
            assert value((x + size * x.mean() * step).clamp_min(0)) > value(x)
    assert value(0.99 * x) > value(x) and value(1.01 * x) > value(x)


def test_a_larger_weight_reduces_noise_at_any_count_level():
    A = tabulated()
    flat = torch.ones(1, 1, *A.domain_shape, dtype=torch.float64)
    for level in (5.0, 500.0):
        views = A(flat)
        counts = torch.poisson(
            level / views.mean() * views, generator=torch.Generator().manual_seed(4)
        )
        spreads = []
        for weight in (1e-3, 0.02, 0.3):
            x = tv_map(A, counts, 30, weight)
            seen = x > 0
            spreads.append((x[seen].std() / x[seen].mean()).item())
        assert spreads[0] > spreads[1] > spreads[2] and spreads[2] < 0.1


def test_invalid_options_of_penalised_counts_are_refused():
    """A penalised likelihood refuses a negative weight and a balance of zero."""
    A = Dense()
    counts = counted(A)
    for method, options, message in (
        (tv_map, {"weight": -1.0}, "weight"),
        (tv_map, {"balance": 0.0}, "positive balance"),
    ):
        with pytest.raises(ValueError, match=message):
            method(A, counts, **options)
