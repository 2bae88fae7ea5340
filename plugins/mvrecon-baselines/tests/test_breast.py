"""Breast-like slices: the same object on every grid, and views that it explains."""

import pytest
import torch
import torch.nn.functional as F

from mvrecon.core.numbers import generator
from mvrecon.core.parts import CAMERAS, PROJECTORS
from mvrecon.geometry.grid import Grid
from mvrecon.kernels.differences import gradient
from mvrecon_baselines.breast import (
    ADIPOSE,
    BRIGHTEST,
    FIBROGLANDULAR,
    BreastSlices,
    random_texture,
    waves,
)

SIZE = 64
GRID = Grid.centred(size=(SIZE, SIZE, 1), spacing=160 / SIZE)
DETECTOR = {"pixels": [1, 2 * SIZE], "pixel_mm": 360 / (2 * SIZE)}
CAMERA = CAMERAS.build("circular", n_views=8, sid=500.0, sdd=1000.0, detector=DETECTOR)


def test_the_truth_explains_the_views_of_its_own_pixels():
    sample = BreastSlices().sample(3, 1, GRID, CAMERA)
    A = PROJECTORS.build("drr", grid=GRID, cameras=CAMERA)
    assert torch.equal(A(sample.volume[None])[0], sample.views)
    assert sample.name == "breast-1-3" and sample.volume.shape == (1, 1, SIZE, SIZE)


def test_a_finer_grid_changes_the_views_but_hardly_the_object():
    one, four = (BreastSlices(fine=fine).sample(0, 0, GRID, CAMERA) for fine in (1, 4))
    for name in ("views", "volume"):
        first, second = getattr(one, name), getattr(four, name)
        assert 1e-3 < (first - second).norm() / second.norm() < 0.12


def test_a_case_is_the_same_object_on_every_grid():
    """With wide edges, so that coarse pixels sample what fine ones average."""
    scene = BreastSlices(detail=4, edge_mm=16.0, specks=(0, 0))
    coarse, fine = (scene.finer(2, 5, GRID, CAMERA, factor) for factor in (1, 4))
    assert (F.avg_pool3d(fine, 4) - coarse).abs().max() < 0.03 * coarse.max()


def test_tissues_have_the_specified_values_and_a_sparse_gradient():
    volume = BreastSlices(detail=6, specks=(0, 0)).sample(0, 0, GRID, CAMERA).volume
    levels = torch.tensor([0.0, ADIPOSE, FIBROGLANDULAR])
    assert torch.equal(volume.unique(), levels)
    radius = 0.45 * SIZE
    assert (volume > 0).sum() == pytest.approx(torch.pi * radius**2, rel=0.01)
    share = (gradient(volume[None], (1, 1, 1)).norm(dim=0) > 0).float().mean()
    assert 0.03 < share < 0.2


def test_specks_are_brightest_and_within_the_data_range():
    scene = BreastSlices(specks=(30, 30))
    volume = scene.sample(0, 0, Grid.centred(size=(256, 256, 1), spacing=0.7), CAMERA).volume
    bright = volume > FIBROGLANDULAR + 1e-6
    assert 0 < bright.float().mean() < 0.01 and volume.max() <= BRIGHTEST == scene.data_range


def test_adjacent_slices_of_a_stack_are_similar():
    grid = Grid.centred(size=(SIZE, SIZE, 8), spacing=160 / SIZE)
    volume = BreastSlices(detail=4, specks=(0, 0)).finer(0, 0, grid, CAMERA, 1)[0]
    near, far = ((volume[k] - volume[0]).norm() for k in (1, 7))
    assert 0 < near < 0.7 * far


def test_the_texture_gradient_equals_finite_differences():
    texture, step = random_texture(generator(0, 0), 4), 1e-5
    line = torch.linspace(-0.5, 0.5, 5, dtype=torch.float64)
    _, slope = waves(texture, line, line, 0.1)
    by_y, by_x = (
        (
            waves(texture, line + dy, line + dx, 0.1)[0]
            - waves(texture, line - dy, line - dx, 0.1)[0]
        )
        / (2 * step)
        for dy, dx in ((step, 0.0), (0.0, step))
    )
    assert torch.allclose(torch.hypot(by_y, by_x), slope, rtol=1e-6)


@pytest.mark.parametrize(
    "options",
    [{"field": 0.6}, {"detail": 0}, {"fine": 0}, {"edge_mm": -1.0}, {"specks": (5, 2)}],
)
def test_numbers_out_of_range_are_refused(options):
    """A breast larger than the grid, no detail, no grid, or specks from more to fewer are
    refused.
    """
    with pytest.raises(ValueError, match=next(iter(options))):
        BreastSlices(**options)
