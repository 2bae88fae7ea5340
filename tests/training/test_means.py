"""DistributedMeans over the cases of a validation."""

import pytest
import torch

from mvrecon.training.module import DistributedMeans


def test_a_mean_is_over_cases_for_any_batch_size():
    cases = torch.tensor([1.0, 2.0, 6.0])
    for parts in ([cases], [cases[:2], cases[2:]]):
        means = DistributedMeans()
        for part in parts:
            means.update({"a": part})
        assert means.compute()["a"].item() == pytest.approx(3.0)
        assert means.compute() == {}, "the next validation begins anew"


def test_a_nan_case_makes_the_mean_nan_and_no_case_adds_nothing():
    means = DistributedMeans()
    means.update({"a": torch.tensor([2.0, torch.nan]), "b": torch.tensor([2.0])})
    means.update({"a": torch.tensor([1.0]), "b": torch.tensor([]), "c": torch.tensor([])})
    found = means.compute()
    assert found["a"].isnan() and found["b"] == 2 and found["c"].isnan()
