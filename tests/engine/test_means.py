"""Means over the cases of a validation."""

import pytest
import torch

from mvrecon.engine.means import Means


def test_a_mean_is_over_cases_whatever_the_batches():
    cases = torch.tensor([1.0, 2.0, 6.0])
    for parts in ([cases], [cases[:2], cases[2:]]):
        means = Means(ignore_nan=False)
        for part in parts:
            means.update({"a": part})
        assert means.compute()["a"].item() == pytest.approx(3.0)
        assert means.compute() == {}, "the next validation begins anew"


@pytest.mark.parametrize(("ignore", "mean"), [(True, 2.0), (False, float("nan"))])
def test_a_case_without_a_figure_counts_or_spoils_the_mean(ignore, mean):
    means = Means(ignore)
    means.update({"a": torch.tensor([2.0, torch.nan])})
    assert means.compute()["a"].item() == pytest.approx(mean, nan_ok=True)
