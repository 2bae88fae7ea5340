"""Cells of pixels or voxels as channels, and padding: each is undone exactly."""

import pytest
import torch
from mvrecon.models.cross_view.cells import from_cells, padded, to_cells, trimmed
from torch.nn.functional import pixel_unshuffle


@pytest.mark.parametrize("shape", [(2, 3, 6, 12), (2, 3, 6, 12, 18)])
@pytest.mark.parametrize("edge", [1, 2, 3])
def test_cells_are_taken_apart_without_a_change(shape, edge):
    x = torch.rand(shape)
    cells = to_cells(x, edge)
    axes = len(shape) - 2
    assert cells.shape == (2, 3 * edge**axes, *(n // edge for n in shape[2:]))
    assert torch.equal(from_cells(cells, edge), x)


def test_cells_of_an_image_have_the_order_of_torch_and_keep_neighbours_together():
    x = torch.rand(2, 3, 6, 4)
    assert torch.equal(to_cells(x, 2), pixel_unshuffle(x, 2))
    volume = torch.rand(1, 1, 4, 4, 4)
    block = volume[0, 0, 2:, :2, 2:].flatten()
    assert torch.equal(to_cells(volume, 2)[0, :, 1, 0, 1], block)


@pytest.mark.parametrize("sizes", [(5,), (1, 7), (3, 1, 8)])
def test_padding_adds_zeros_behind_and_is_trimmed_off(sizes):
    x = torch.rand(1, 2, *sizes) + 1
    y = padded(x, 4)
    assert all(n % 4 == 0 for n in y.shape[2:])
    assert torch.equal(trimmed(y, sizes), x)
    assert float(y.double().sum()) == pytest.approx(float(x.double().sum()))
