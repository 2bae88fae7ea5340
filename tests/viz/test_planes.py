"""Planes: which voxel is shown where, and in which colour."""

import numpy as np
import pytest
import torch

from mvrecon.viz.planes import brightest, grey, middle_planes, signed


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


def test_projections_see_points_off_the_middle():
    assert all(plane.sum() == 0 for plane in middle_planes(volume_with_a_point(0, 1, 2)))
    along_z, along_y, along_x = brightest(volume_with_a_point(0, 1, 2))
    assert along_z.nonzero().tolist() == [[1, 2]]
    assert along_y.nonzero().tolist() == [[5, 2]]
    assert along_x.nonzero().tolist() == [[5, 1]]


def test_grey_maps_the_window_to_black_and_white():
    image = grey(torch.tensor([[-1.0, 0.0, 1.0, 2.0, 9.0, torch.nan]]), (0.0, 2.0))
    assert image.dtype == np.uint8 and image.shape == (1, 6, 3)
    assert image[0, :5, 0].tolist() == [0, 0, 128, 255, 255]
    assert (image[0, :5] == image[0, :5, :1]).all()
    assert image[0, 5].tolist() == [255, 0, 0]


def test_signed_colours_tell_the_sign():
    image = signed(torch.tensor([[0.0, 2.0, -2.0, 1.0, 50.0]]), 2.0)
    assert image[0].tolist() == [[255, 255, 255], [255, 0, 0], [0, 0, 255], [255, 128, 128], [255, 0, 0]]


def test_an_empty_window_is_refused():
    with pytest.raises(ValueError, match="lower end below"):
        grey(torch.zeros(2, 2), (1.0, 1.0))
    with pytest.raises(ValueError, match="positive limit, got 0"):
        signed(torch.zeros(2, 2), 0.0)
