"""Boxes of voxels, and the grids that they cut out."""

import pytest
import torch

from mvrecon.geometry.grid import Box, Grid, placed, voxel_centres


def test_a_box_bounds_the_mask_tightly():
    mask = torch.zeros(2, 1, 7, 8, 9, dtype=torch.bool)
    mask[0, 0, 2, 3, 8], mask[1, 0, 4, 1, 5] = True, True
    box = Box.around(mask)
    assert (box.low, box.high, box.shape, box.size) == ((2, 1, 5), (5, 4, 9), (3, 3, 4), 36)
    assert mask[..., *box.slices].sum() == mask.sum()


def test_an_empty_mask_has_an_empty_box():
    box = Box.around(torch.zeros(4, 4, 4, dtype=torch.bool))
    assert box.size == box.grown(2, (4, 4, 4)).size == box.aligned(2, (4, 4, 4)).size == 0


def test_growing_and_aligning_stay_inside_the_volume():
    box = Box((0, 3, 5), (2, 4, 9))
    assert box.grown(2, (7, 8, 9)) == Box((0, 1, 3), (4, 6, 9))
    assert box.aligned(4, (7, 8, 9)) == Box((0, 0, 4), (4, 4, 9))


def test_a_cropped_grid_keeps_the_positions_of_its_voxels():
    grid, box = (
        Grid.centred(size=(8, 7, 6), spacing=(1.0, 2.0, 3.0), centre=(9.0, -4.0, 1.0)),
        Box((1, 2, 3), (4, 7, 5)),
    )
    assert torch.equal(voxel_centres(grid.cropped(box)), voxel_centres(grid)[box.slices])


@pytest.mark.parametrize(
    "box", [Box((0, 0, 0), (0, 1, 1)), Box((0, 0, 0), (1, 1, 9)), Box((-1, 0, 0), (1, 1, 1))]
)
def test_cropping_a_grid_to_nothing_or_beyond_it_is_refused(box):
    with pytest.raises(ValueError, match="cannot be cropped"):
        Grid.centred(size=(8, 7, 6), spacing=1.0).cropped(box)


def test_a_crop_is_pasted_back_in_its_position():
    whole, box = torch.rand(2, 7, 8, 9), Box((2, 3, 2), (4, 7, 8))
    part = whole[:, *box.slices]
    back = placed(part, box, (7, 8, 9))
    assert torch.equal(back[:, *box.slices], part) and back.sum() == pytest.approx(
        part.sum().item()
    )
