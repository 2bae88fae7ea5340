"""Planes: which voxel is shown where, and in which colour."""

import numpy as np
import pytest
import torch

from mvrecon.geometry.cameras.rigs import dcspect80
from mvrecon.geometry.grid import Grid, voxel_centres
from mvrecon.report.viz.images import Edges, brightest, content, grey, planes, signed

GRID = Grid.centred(shape=(6, 8, 10), spacing=2.0)
RADIOLOGICAL = [Edges("R", "L", "A", "P"), Edges("R", "L", "H", "F"), Edges("A", "P", "H", "F")]


def volume_with_a_point(z, y, x):
    volume = torch.zeros(GRID.shape)
    volume[z, y, x] = 1
    return volume


def test_planes_pass_through_a_point_in_the_radiological_convention():
    volume, point = volume_with_a_point(1, 6, 2), torch.tensor([-5.3, 4.6, -2.9])
    across_z, across_y, across_x = planes(volume, GRID, point.double())
    assert [plane.edges for plane in (across_z, across_y, across_x)] == RADIOLOGICAL
    assert (across_z.name, across_y.name, across_x.name) == ("z = -3 mm", "y = 5 mm", "x = -5 mm")
    assert across_z.pixels.shape == (8, 10) and across_z.pixels.nonzero().tolist() == [[1, 7]]
    assert across_y.pixels.shape == (6, 10) and across_y.pixels.nonzero().tolist() == [[4, 7]]
    assert across_x.pixels.shape == (6, 8) and across_x.pixels.nonzero().tolist() == [[4, 1]]


@pytest.mark.parametrize(
    ("axes", "signs"),
    [
        ((0, 1, 2), (-1, -1, 1)),
        ((1, 2, 0), (1, 1, 1)),
        ((2, 0, 1), (1, -1, -1)),
        ((1, 0, 2), (-1, 1, 1)),
        ((2, 1, 0), (-1, -1, -1)),
    ],
)
def test_a_volume_in_any_order_of_its_axes_looks_the_same(axes, signs):
    """Voxels stored along other axes of the patient: the same planes, in another order."""
    volume = torch.rand(GRID.shape)
    expected = {plane.name: plane for plane in planes(volume, GRID)}
    flips = [2 - axis for axis, sign in zip(axes, signs, strict=True) if sign < 0]
    stored = volume.flip(flips).permute([2 - axis for axis in axes[::-1]])
    affine = torch.eye(4, dtype=torch.float64)
    affine[:3, :3] = torch.eye(3)[:, list(axes)] * 2.0 * torch.tensor(signs)
    half = (torch.tensor(stored.shape[::-1], dtype=torch.float64) - 1) / 2
    affine[:3, 3] = GRID.centre - affine[:3, :3] @ half
    middle = GRID.to_world((GRID.centre_index + 0.5).floor())
    for plane in planes(stored, Grid(tuple(stored.shape), affine), middle):
        same = expected[plane.name]
        assert torch.equal(plane.pixels, same.pixels) and plane.edges == same.edges


def test_content_is_what_most_views_see_in_activity_and_in_hu():
    """A heart at the isocentre beside a hotter liver below, and a patient in air."""
    grid = Grid.centred(40, spacing=8.0, centre=(40.0, -40.0, 0.0))
    points = voxel_centres(grid)
    heart, liver = torch.zeros(3), torch.tensor([70.0, -30.0, -100.0])
    volume = 1.0 * ((points - heart).norm(dim=-1) < 40) + 2.0 * ((points - liver).norm(dim=-1) < 50)
    assert (content(volume, grid) - liver).norm() < 10
    assert (content(volume, grid, dcspect80()) - heart).norm() < 15
    body = (points - grid.centre).norm(dim=-1) < 120
    bone = (points - grid.centre - torch.tensor([0.0, -90.0, 0.0])).norm(dim=-1) < 20
    hu = torch.where(bone, 1500.0, torch.where(body, 40.0, -1000.0))
    assert (content(hu, grid) - grid.centre).norm() < 16
    assert torch.equal(content(torch.zeros(grid.shape), grid), grid.centre)


def test_projections_show_off_centre_points():
    assert all(plane.pixels.sum() == 0 for plane in planes(volume_with_a_point(0, 1, 2), GRID))
    along_z, along_y, along_x = brightest(volume_with_a_point(0, 1, 2), GRID)
    assert [plane.edges for plane in (along_z, along_y, along_x)] == RADIOLOGICAL
    assert along_z.pixels.nonzero().tolist() == [[6, 7]]
    assert along_y.pixels.nonzero().tolist() == [[5, 7]]
    assert along_x.pixels.nonzero().tolist() == [[5, 6]]


@pytest.mark.parametrize("draw", [planes, brightest])
def test_a_sphere_is_round_on_any_grid(draw):
    grid = Grid.centred(size=(20, 33, 32), spacing=(16.0, 10.0, 12.0))
    distance = voxel_centres(grid, torch.float32).norm(dim=-1)
    images = [plane.pixels for plane in draw((120 - distance) / 120, grid)]  # positive in 120 mm
    assert [list(image.shape) for image in images] == [[33, 32], [38, 32], [38, 33]]
    for image in images:
        inside = image > 0.25  # within 90 mm: 18 pixels of 10 mm
        rows, columns = inside.any(dim=1).sum().item(), inside.any(dim=0).sum().item()
        assert rows == pytest.approx(18, abs=1) and abs(rows - columns) <= 1


def test_equal_spacing_shows_voxels_unchanged():
    volume = torch.rand(GRID.shape)
    volume[3, 4, 5] = torch.nan
    across_z = planes(volume, GRID)[0].pixels
    assert across_z.isnan().sum() == 1
    assert torch.equal(across_z.nan_to_num(), volume[3].flip(0, 1).nan_to_num())


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
