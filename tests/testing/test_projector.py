"""A projector that breaks its contract is caught, and the message says how."""

import pytest
import torch

from mvrecon.core.parts import PROJECTORS
from mvrecon.operators.drr import Drr
from mvrecon.testing import check_projector
from tests.operators.rigs import CONE, GRID


class Misshapen(Drr):
    """Loses a column."""

    def forward(self, volume):
        return super().forward(volume)[..., :-1]


class Widened(Drr):
    """Gives float64 for float32."""

    def forward(self, volume):
        return super().forward(volume).double()


class Spoiled(Drr):
    """Gives NaN in one pixel."""

    def forward(self, volume):
        views = super().forward(volume)
        views[0, 0, 0, 0, 0] = torch.nan
        return views


class Unmatched(Drr):
    """Has an adjoint that is a thousandth too large."""

    def adjoint(self, views):
        return 1.001 * super().adjoint(views)


class Mistaken:
    """Is no projector at all."""

    def __init__(self, grid, cameras):
        self.grid, self.cameras = grid, cameras


BROKEN = {
    Misshapen: "views are .*, expected",
    Widened: "float32 volumes are torch.float64",
    Spoiled: "1 views of finite volumes are not finite",
    Unmatched: "<A x, y> and <x, A.T y> differ by .* in torch",
    Mistaken: "expected a LinearOperator, got Mistaken",
}


@pytest.mark.parametrize("part", BROKEN)
def test_a_projector_that_breaks_its_contract_is_caught(part, monkeypatch):
    monkeypatch.setitem(PROJECTORS._parts, "broken", part)
    with pytest.raises(AssertionError, match=BROKEN[part]):
        check_projector("broken", GRID, CONE, gradients=False)
