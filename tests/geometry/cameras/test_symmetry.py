"""A rig that is its own mirror image sees the mirrored object as its partners do; nothing else
counts as symmetric.
"""

from dataclasses import replace

import pytest
import torch

from mvrecon.geometry.cameras.rigs import arc, circular, dcspect80, dome, parallel
from mvrecon.geometry.cameras.symmetry import mirror_pairs
from mvrecon.geometry.grid import Grid
from mvrecon.geometry.rigid import random_rotation
from mvrecon.operators.ray_transform import RayTransform
from tests.geometry.cameras.rigs import DETECTOR, random_cameras

GRID = Grid.centred(size=(8, 5, 6), spacing=(11.0, 9.0, 7.0))
SHIFTED = {**DETECTOR, "offset_mm": [5.0, 0.0]}  # down
ASIDE = {**DETECTOR, "offset_mm": [0.0, 5.0]}
CASES = {
    "dcspect80": (dcspect80(pixels=[4, 5], columns=[0, 7]), -3),
    "one row of dcspect80 and its image": (dcspect80(pixels=[3, 2], rows=[0, 3], columns=[3]), -3),
    "half a circle": (circular(5, 400.0, 800.0, DETECTOR, 180.0, 10.0), -3),
    "full circle": (
        circular(6, 400.0, 800.0, DETECTOR),
        -1,
    ),  # across x, where no camera stands alone
    "full circle, detectors shifted down": (circular(6, 400.0, 800.0, SHIFTED), -1),
    "half a circle, detectors shifted aside": (circular(5, 400.0, 800.0, ASIDE, 180.0), -3),
    "arc about the y axis": (arc(4, 400.0, 700.0, DETECTOR, 120.0, 30.0), -1),
    "parallel": (parallel(4, DETECTOR, depth_mm=300.0), -3),
    "parallel, full circle": (parallel(4, SHIFTED, depth_mm=300.0, arc_degrees=360.0), -2),
}


@pytest.mark.parametrize("name", CASES)
def test_the_mirrored_object_is_seen_as_the_partners_see_the_object(name):
    cameras, axis = CASES[name]
    torch.manual_seed(0)
    R, t = random_rotation(torch.Generator().manual_seed(1)), torch.tensor([3.0, -5.0, 70.0])
    for grid, rig in ((GRID, cameras), (GRID.moved(R, t), cameras.moved(R, t))):
        mirror = mirror_pairs(rig, grid)
        assert mirror is not None and mirror.axis == axis
        A = RayTransform(grid, rig, backend="reference")
        x = torch.rand(1, 1, *grid.shape, dtype=torch.float64)
        torch.testing.assert_close(
            A(mirror.volume(x)), mirror.views(A(x)), rtol=1e-10, atol=1e-10 * A(x).max().item()
        )
        y = torch.rand_like(A(x))
        torch.testing.assert_close(
            A.T(mirror.views(y)), mirror.volume(A.T(y)), rtol=1e-10, atol=1e-8
        )


@pytest.mark.parametrize("name", CASES)
def test_two_reflections_cancel_and_half_a_rig_with_its_mirror_image_is_complete(name):
    cameras, _ = CASES[name]
    mirror = mirror_pairs(cameras, GRID)
    assert mirror is not None
    number = torch.arange(len(cameras))
    assert torch.equal(mirror.partner[mirror.partner], number)
    y = torch.rand(2, 1, len(cameras), *cameras.shape)
    assert torch.equal(mirror.views(mirror.views(y)), y)
    share = mirror.share[:, None, None].expand(len(cameras), *cameras.shape)
    assert torch.equal(share + mirror.views(share), torch.ones_like(share))


def test_the_rows_of_dcspect80_are_mirror_images_to_the_precision_of_the_table():
    mirror = mirror_pairs(dcspect80(), Grid.centred((8, 8, 8), 10.0), tolerance=1e-14)
    assert mirror is not None and mirror.axis == -3 and mirror.rows.all()
    assert torch.equal(mirror.partner, torch.arange(80).reshape(4, 20).flip(0).flatten())
    assert mirror.share.tolist() == [1.0] * 40 + [0.0] * 40


def test_cameras_on_a_circle_are_symmetric_about_its_plane():
    half = mirror_pairs(circular(8, 400.0, 800.0, DETECTOR, 180.0), GRID)
    assert half is not None and half.axis == -3 and half.rows.all() and (half.share == 0.5).all()
    full = mirror_pairs(circular(8, 400.0, 800.0, DETECTOR), GRID)
    assert full is not None and not full.rows.any()
    assert full.partner.tolist() == [0, 7, 6, 5, 4, 3, 2, 1]  # across y, which pairs as many as x
    between = mirror_pairs(circular(8, 400.0, 800.0, DETECTOR, start_degrees=22.5), GRID)
    assert between is not None and not (between.share == 0.5).any()


@pytest.mark.parametrize(
    ("cameras", "grid"),
    [
        (dome(16, 200.0, 70.0, 180.0, DETECTOR), GRID),
        (random_cameras(4), GRID),
        (dcspect80(rows=[0, 1, 2]), GRID),
        (
            dcspect80(),
            Grid.centred(size=(8, 5, 6), spacing=9.0, centre=(0.0, 0.0, 1e-3)),
        ),  # not about the rig's plane
        (circular(5, 400.0, 800.0, SHIFTED, 180.0, 10.0), GRID),
        (
            circular(5, 400.0, 800.0, DETECTOR, 180.0, 10.0).moved(
                torch.eye(3), torch.tensor([0.0, 0.0, 1e-3])
            ),
            GRID,
        ),
    ],
)
def test_asymmetric_rigs_have_no_mirror_plane(cameras, grid):
    assert mirror_pairs(cameras, grid) is None


@pytest.mark.parametrize("name", ["source", "origin", "u", "v"])
def test_a_displaced_camera_is_distinguished_from_rounding(name):
    cameras = dcspect80(pixels=[4, 5], columns=[0, 7])
    for part, symmetric in ((1e-11, True), (1e-7, False)):
        moved = getattr(cameras, name).clone()
        moved[2] += 300.0 * part * torch.tensor([0.3, 0.5, 0.8])
        assert (mirror_pairs(replace(cameras, **{name: moved}), GRID) is not None) is symmetric


def test_a_sheared_grid_has_no_mirror_plane_across_the_sheared_axes():
    cameras = circular(5, 400.0, 800.0, DETECTOR, 180.0, 10.0)
    affine = GRID.affine.clone()
    affine[0, 1] += 3.0  # y leans towards x: z stays square to both
    affine[:3, 3] -= Grid(GRID.shape, affine).centre
    mirror = mirror_pairs(cameras, Grid(GRID.shape, affine))
    assert mirror is not None and mirror.axis == -3
    affine = GRID.affine.clone()
    affine[2, 0] += 3.0  # x leans towards z: a voxel's mirror image across z is no voxel
    affine[:3, 3] -= Grid(GRID.shape, affine).centre
    assert mirror_pairs(cameras, Grid(GRID.shape, affine)) is None


def test_duplicate_cameras_have_separate_partners():
    once = dcspect80(pixels=[4, 5], columns=[3])
    twice = once[[0, 1, 2, 3, 0, 3, 1, 2]]
    mirror = mirror_pairs(twice, GRID)
    assert mirror is not None and sorted(mirror.partner.tolist()) == list(range(8))
    assert mirror_pairs(once[[0, 1, 2, 3, 0]], GRID) is None
