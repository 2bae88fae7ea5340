"""No ray reads outside the stored part of a volume, wherever it touches that part."""

import math

import pytest
import torch

from mvrecon.geometry.grid import Box, Grid
from mvrecon.kernels.rays.cuda import operators as cuda
from mvrecon.kernels.rays.occupancy import Occupancy
from mvrecon.operators.radon import Radon
from tests.kernels.rays.test_bounds import GUARD, SLOPES, N, rig


def between_guards(monkeypatch: pytest.MonkeyPatch) -> None:
    """Put NaN in front of the numbers that an operator works in, and behind them."""
    plain = cuda.Call.new

    def new(self, *shape, dtype=None, zero=False):
        part = plain(self, *shape, dtype=dtype, zero=zero)
        if not part.is_floating_point():
            return part
        memory = torch.full((part.numel() + 2 * GUARD,), math.nan, dtype=part.dtype)
        inside = memory[GUARD:-GUARD].view(shape)
        return inside.copy_(part)

    monkeypatch.setattr(cuda.Call, "new", new)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("method", ["joseph", "siddon"])
def test_rays_along_the_boundary_of_a_box_stay_inside_its_store(method, dtype, host, monkeypatch):
    x, whole = torch.ones(1, 13, 11, 11, dtype=dtype), Grid.centred(N, 1.0)
    for turn in (0.0, 90.0, 180.0, 270.0):
        for slope in SLOPES:
            A = Radon(whole, rig(slope, turn))
            part = Occupancy(whole.shape, Box((6, 5, 5), (19, 16, 16)))
            rays = A.fixed_lines, A.ray_extent, list(A.detector), method, part
            expected = cuda.project(x, *rays)
            with monkeypatch.context() as context:
                between_guards(context)
                assert torch.equal(cuda.project(x, *rays), expected)
