"""Unusual input: none, spread, strided, and one volume among others."""

import pytest
import torch

from mvrecon.testing import gap
from tests.operators.cases import CASES, OPTIONS, noise

KINDS = ["cone", "stack", "dome", "explicit"]


@pytest.mark.pairwise(kind=KINDS, option=OPTIONS)
def test_zero_input_gives_zero_output(kind, option):
    case = CASES[kind]
    A = case.build(**OPTIONS[option])
    for batch, channels in ((0, 1), (2, 0)):
        x = torch.zeros(batch, channels, *case.grid.shape, requires_grad=True)
        y = torch.zeros(batch, channels, len(case.rays), *case.rays.shape, requires_grad=True)
        views, volume = A(x), A.T(y)
        assert views.shape == y.shape and volume.shape == x.shape
        by_x, by_y = torch.autograd.grad(views.sum() + volume.sum(), (x, y))
        assert by_x.shape == x.shape and by_y.shape == y.shape


@pytest.mark.pairwise(1, kind=KINDS, option=OPTIONS)
def test_memory_layout_changes_no_bit(kind, option):
    case = CASES[kind]
    A = case.build(**OPTIONS[option])
    for act, values in zip((A, A.T), noise(case, torch.float32, channels=3), strict=True):
        expected = act(values)
        for swapped in (
            values.transpose(0, 1).contiguous().transpose(0, 1),
            values.mT.contiguous().mT,
        ):
            assert not swapped.is_contiguous() and torch.equal(act(swapped), expected)
        flipped = values.movedim((2, 3), (3, 2)).contiguous().movedim((2, 3), (3, 2))
        assert torch.equal(act(flipped), expected)
        wide = torch.zeros(*values.shape[:-1], 2 * values.shape[-1])
        wide[..., ::2] = values
        assert torch.equal(act(wide[..., ::2]), expected)
        spread = values[:1, :1, :, :1].expand(2, 3, -1, values.shape[3], *[-1] * (values.ndim - 4))
        assert torch.equal(act(spread), act(spread.contiguous()))


@pytest.mark.pairwise(2, kind=KINDS, option=OPTIONS)
def test_volumes_are_projected_independently(kind, option):
    case = CASES[kind]
    A = case.build(**OPTIONS[option])
    for act, values in zip((A, A.T), noise(case, torch.float32, channels=2), strict=True):
        assert gap(act(values)[1:, 1:], act(values[1:, 1:])) < (
            1e-5 if option == "siddon" else 1e-6
        )
        assert torch.equal(act(values), act(values)), "twice the same"


@pytest.mark.pairwise(3, kind=KINDS, option=OPTIONS)
def test_inputs_are_not_modified(kind, option):
    case = CASES[kind]
    A = case.build(**OPTIONS[option])
    for act, values in zip((A, A.T), noise(case, torch.float32), strict=True):
        before = values.clone()
        act(values)
        assert torch.equal(values, before)
