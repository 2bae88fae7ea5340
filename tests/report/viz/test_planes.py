"""Planes: which voxel is shown where, and in which colour."""

import numpy as np
import pytest
import torch

from mvrecon.geometry.grid import Grid, voxel_centres
from mvrecon.report.viz.images import brightest, grey, middle_planes, signed


def volume_with_a_point(z, y, x, shape=(6, 8, 10)):
    volume = torch.zeros(shape)
    volume[z, y, x] = 1
    return volume


def test_planes_pass_through_the_centre_with_z_up():
    across_z, across_y, across_x = middle_planes(volume_with_a_point(3, 4, 5))
    assert across_z.shape == (8, 10) and across_y.shape == (6, 10) and across_x.shape == (6, 8)
    assert across_z.nonzero().tolist() == [[4, 5]]
    assert across_y.nonzero().tolist() == [[2, 5]]  # row 6 - 1 - 3
    assert across_x.nonzero().tolist() == [[2, 4]]


def test_projections_show_off_centre_points():
    assert all(plane.sum() == 0 for plane in middle_planes(volume_with_a_point(0, 1, 2)))
    along_z, along_y, along_x = brightest(volume_with_a_point(0, 1, 2))
    assert along_z.nonzero().tolist() == [[1, 2]]
    assert along_y.nonzero().tolist() == [[5, 2]]
    assert along_x.nonzero().tolist() == [[5, 1]]


@pytest.mark.parametrize("draw", [middle_planes, brightest])
def test_a_sphere_is_round_on_any_grid(draw):
    grid = Grid.centred(size=(20, 33, 32), spacing=(16.0, 10.0, 12.0))
    distance = voxel_centres(grid, torch.float32).norm(dim=-1)
    images = draw((120 - distance) / 120, grid.spacing)  # positive within 120 mm
    assert [list(image.shape) for image in images] == [[33, 32], [38, 32], [38, 33]]
    for image in images:
        inside = image > 0.25  # within 90 mm: 18 pixels of 10 mm
        rows, columns = inside.any(dim=1).sum().item(), inside.any(dim=0).sum().item()
        assert rows == pytest.approx(18, abs=1) and abs(rows - columns) <= 1


def test_equal_spacing_shows_voxels_unchanged():
    volume = torch.rand(6, 8, 10)
    volume[3, 4, 5] = torch.nan
    for plain, scaled in zip(
        middle_planes(volume), middle_planes(volume, (4.0, 4.0, 4.0)), strict=True
    ):
        assert plain.isnan().sum() == 1 and torch.equal(plain.nan_to_num(), scaled.nan_to_num())


def test_grey_maps_the_window_to_black_and_white():
    image = grey(torch.tensor([[-1.0, 0.0, 1.0, 2.0, 9.0, torch.nan]]), (0.0, 2.0))
    assert image.dtype == np.uint8 and image.shape == (1, 6, 3)
    assert image[0, :5, 0].tolist() == [0, 0, 128, 255, 255]
    assert (image[0, :5] == image[0, :5, :1]).all()
    assert image[0, 5].tolist() == [255, 0, 0]


def test_signed_colours_distinguish_the_sign():
    image = signed(torch.tensor([[0.0, 2.0, -2.0, 1.0, 50.0]]), 2.0)
    assert image[0].tolist() == [
        [255, 255, 255],
        [255, 0, 0],
        [0, 0, 255],
        [255, 128, 128],
        [255, 0, 0],
    ]


def test_an_empty_window_is_refused():
    with pytest.raises(ValueError, match="lower end below"):
        grey(torch.zeros(2, 2), (1.0, 1.0))
    with pytest.raises(ValueError, match="positive limit, got 0"):
        signed(torch.zeros(2, 2), 0.0)
