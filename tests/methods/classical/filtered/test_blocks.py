"""Filtered back-projection is linear, differentiable, and the same in blocks of views."""

import pytest
import torch

from mvrecon.geometry.cameras.rigs import circular, parallel
from mvrecon.geometry.grid import Grid
from mvrecon.methods.classical import fdk as streaming
from mvrecon.methods.classical.fdk import fbp, fdk, fdk_streamed
from mvrecon.operators.drr import Drr
from mvrecon.operators.radon import Radon
from tests.methods.classical.filtered.scans import CONES, VOLUME

SMALL = Grid.centred(size=(5, 4, 8), spacing=3.0)
RIG = circular(7, 60.0, 90.0, {"pixels": [9, 10], "pixel_mm": 4.0}, start_degrees=5.0)
A = Drr(SMALL, RIG)


def test_a_batch_equals_its_cases_and_conserves_sums():
    torch.manual_seed(0)
    views = torch.randn(2, 3, *A.range_shape)
    x = fdk(A, views)
    assert x.shape == (2, 3, 8, 4, 5)
    for b in range(2):
        assert torch.allclose(x[b : b + 1], fdk(A, views[b : b + 1]), atol=1e-6)
    x, y = (fdk(A, some, extrapolate=False) for some in (views, 2 * views[:1] - views[1:]))
    assert torch.allclose(y, 2 * x[:1] - x[1:], atol=1e-5)


@pytest.mark.parametrize("shift_mm", [0.0, 9.0])
def test_the_gradient_is_the_exact_transpose(shift_mm):
    panel = {"pixels": [9, 10], "pixel_mm": 4.0, "offset_mm": [0.0, shift_mm]}
    A = Drr(SMALL, circular(7, 60.0, 90.0, panel, start_degrees=5.0))
    y = torch.randn(1, 1, *A.range_shape, dtype=torch.float64, requires_grad=True)
    x = fdk(A, y, "hann")
    assert x.dtype == torch.float64 and x.abs().max() > 0
    z = torch.randn_like(x)
    (slope,) = torch.autograd.grad((x * z).sum(), y)
    assert (slope * y).sum().item() == pytest.approx((x * z).sum().item(), rel=1e-10)
    rig = parallel(4, {"pixels": [1, 5], "pixel_mm": 2.0})
    beam = Radon(Grid.centred(size=(3, 3, 1), spacing=2.0), rig)
    flat = torch.randn(1, 1, 4, 1, 5, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda y: fbp(beam, y), (flat,))


def test_views_are_read_once_in_blocks_of_the_given_size(monkeypatch):
    """A reader of five views at a time; the volume is that of all at once."""
    rig = CONES["full"]
    rows, columns = rig.shape
    views = torch.rand(1, 1, len(rig), rows, columns)
    whole, calls = fdk(Drr(VOLUME, rig), views), []

    def read(first: int, last: int):
        calls.append((first, last))
        return views[0, 0, first:last].numpy()

    monkeypatch.setattr(streaming, "BLOCK_PIXELS", 5 * (rows + 2) * columns + 1)
    streamed = fdk_streamed(read, rig, VOLUME)
    assert calls == [(k, k + 5) for k in range(0, 120, 5)]
    assert torch.allclose(streamed, whole, atol=1e-6 * whole.abs().max().item())
    assert torch.allclose(fdk(Drr(VOLUME, rig), views), streamed, atol=1e-6)
    monkeypatch.setattr(streaming, "FILTERED_PIXELS", 2 * (rows + 2) * columns + 1)
    assert torch.equal(fdk_streamed(read, rig, VOLUME), streamed)  # two views filtered at a time


def test_a_reader_that_returns_too_few_views_is_refused():
    """A block of streamed views that is too small, of integers, or not finite is refused."""
    rows, columns = RIG.shape
    with pytest.raises(ValueError, match=r"Expected views .* \(7, 9, 10\)"):
        fdk_streamed(lambda first, last: torch.zeros(last - first - 1, rows, columns), RIG, SMALL)
    with pytest.raises(ValueError, match="of floating point"):
        fdk_streamed(lambda first, last: torch.zeros(7, 9, 10, dtype=torch.int16), RIG, SMALL)
    with pytest.raises(ValueError, match="must be finite"):
        fdk_streamed(lambda first, last: torch.full((7, 9, 10), torch.nan), RIG, SMALL)


def test_the_weights_of_the_same_rig_change_nothing():
    views = torch.rand(1, 1, *A.range_shape)
    assert torch.equal(fdk(A, views, weights_from=RIG), fdk(A, views))


def test_the_volume_is_zero_outside_the_support():
    views, support = torch.rand(1, 1, *A.range_shape), torch.rand(SMALL.shape) > 0.5
    x = fdk(A, views)
    assert torch.equal(fdk(A.with_support(support), views), torch.where(support, x, 0))
