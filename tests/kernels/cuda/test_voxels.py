"""Voxel-driven back-projection of CUDA devices, compiled by g++ and run in main memory, against the
reference.
"""

from dataclasses import replace

import pytest
import torch

from mvrecon.geometry.cameras.rigs import circular
from mvrecon.geometry.grid import Grid
from mvrecon.kernels.voxels import backproject_reference, cuda
from mvrecon.operators.voxel_driven import image_maps
from mvrecon.testing import inner_product_gap
from tests.kernels.cuda.scenes import RIGS, difference
from tests.kernels.cuda.waits import Waits

#: A column of a thread's voxels and a part of one, of a world that leans.
TALL = Grid.centred(size=(5, 6, 19), spacing=(1.0, 1.2, 0.9), centre=(3.0, -2.0, 4.0))
#: Several tiles along each axis, and more views than a block prepares at once.
TILES = Grid.centred(size=(19, 11, 10), spacing=(1.0, 1.2, 0.9))
MANY = circular(70, 40.0, 70.0, {"pixels": [7, 9], "pixel_mm": 4.0}, start_degrees=13.0)
OTHERS = {"tall": (TALL, RIGS["dome"][1]), "tiles": (TILES, MANY)}
KINDS = ["cone", "dome", "parallel", "line", "inside", "wide", "slice", "large", "dcspect80"]


@pytest.mark.pairwise(kind=[*KINDS, *OTHERS], dtype=[torch.float64, torch.float32])
def test_volumes_and_the_transpose_match_the_reference(kind, dtype, host):
    bound = 1e-11 if dtype == torch.float64 else 3e-6
    torch.manual_seed(1)
    grid, cameras = (RIGS | OTHERS)[kind]
    maps, window = image_maps(cameras, grid), list(cameras.ray_extent)
    y = torch.randn(2, len(cameras), *cameras.shape, dtype=dtype)
    for weighted in (False, True):
        wide = y.double().requires_grad_()
        volumes = backproject_reference(wide, maps, window, weighted, list(grid.shape))
        x = torch.randn(volumes.shape, dtype=dtype)
        (views,) = torch.autograd.grad((volumes * x).sum(), wide)
        rest = maps, window, weighted
        assert difference(cuda.backproject(y, *rest, list(grid.shape)), volumes) < bound
        assert difference(cuda.project(x, *rest, list(cameras.shape)), views) < bound


def test_a_back_projection_launches_one_kernel_without_synchronisation(host):
    grid, cameras = RIGS["cone"]
    rest = image_maps(cameras, grid), list(cameras.ray_extent), True
    y = torch.randn(1, len(cameras), *cameras.shape)
    with Waits() as waits:
        x = cuda.backproject(y, *rest, list(grid.shape))
        cuda.project(x, *rest, list(cameras.shape))
    assert waits.names == [] and host.launches == ["voxel_backproject", "voxel_project"]
    assert not cuda.backproject(y[:, :0], rest[0][:0], *rest[1:], list(grid.shape)).any()


def test_a_beam_wider_than_its_source_distance_has_a_matched_transpose(host):
    """Pixels whose rays open by more than a right angle touch voxels without bound."""
    grid, cameras = RIGS["wide"]
    near = replace(cameras, source=cameras.source + 0.9 * (grid.centre - cameras.source))
    maps, window = image_maps(near, grid), list(near.ray_extent)
    x = torch.randn(1, *grid.shape, dtype=torch.float64)
    y = torch.randn(1, len(near), *near.shape, dtype=torch.float64)
    volume = cuda.backproject(y, maps, window, False, list(grid.shape))
    views = cuda.project(x, maps, window, False, list(near.shape))
    assert (volume * x).sum().abs() > 1e-3 and inner_product_gap(y, volume, x, views) < 1e-11
