"""The voxel-driven adjoint is the transpose of the ray-driven projection, to rounding, for every
kind of camera.
"""

from dataclasses import replace

import numpy as np
import pytest
import torch
from numba import njit

from mvrecon.cameras.dcspect80 import dcspect80
from mvrecon.cameras.rigs import circular
from mvrecon.geometry.grid import Grid
from mvrecon.kernels.rays import ops
from mvrecon.kernels.rays.cuda.gather import View, collect, record
from mvrecon.kernels.rays.lines import lines_of
from mvrecon.kernels.rays.projection_matrix import projection_matrix
from mvrecon.kernels.rays.trace import Space
from tests.projectors.rigs import AXIAL, CONE, GRID, INSIDE, PARALLEL, PINHOLES

BODY = Grid.centred(size=(10, 8, 9), spacing=22.0)
#: A source in the volume, its detector so wide that voxels lie on both sides of the source.
WIDE = circular(2, 40.0, 70.0, {"pixels": [6, 5], "pixel_mm": 25.0}).moved(
    torch.eye(3), GRID.centre
)
WIDE = replace(
    WIDE, source=GRID.centre + torch.tensor([0.9, -0.7, 0.6]) + 0.02 * (WIDE.source - GRID.centre)
)
RIGS = {
    "cone": (GRID, CONE),
    "dome": (GRID, PINHOLES),
    "parallel": (GRID, PARALLEL),
    "line": (GRID, replace(PARALLEL, extent="line")),
    "inside": (GRID, INSIDE),
    "wide": (GRID, WIDE),
    "axial": (GRID, AXIAL),
    "dcspect80": (BODY, dcspect80()[::16].binned(8)),
}


@njit
def record_all(lines, window, sizes, detector, rays, frames):
    space = Space(window, sizes, (0, 0, 0, sizes[0], sizes[1], sizes[2]))
    for m in range(len(lines)):
        projection_matrix(lines[m], frames[m])
        for v in range(detector[0]):
            for u in range(detector[1]):
                pixel = (u - (detector[1] - 1) / 2, v - (detector[0] - 1) / 2)
                record(lines[m], pixel, space, rays, (m * detector[0] + v) * detector[1] + u)


@njit
def collect_all(rays, frames, values, sizes, detector, volume):
    for m in range(len(frames)):
        start = m * detector[0] * detector[1]
        for z in range(sizes[2]):
            for y in range(sizes[1]):
                for x in range(sizes[0]):
                    for axis in range(3):
                        view = View(frames[m], rays, values, start, start, sizes, detector)
                        collect(view, (x, y, z), axis, 0, volume[z, y, x], np.float64)


def gathered(views, lines, window, shape):
    n, m, *detector = views.shape
    rays, frames = np.zeros((8, views[0].numel())), np.zeros((m, 3, 4))
    volume, sizes = np.zeros((*shape, n)), tuple(shape[::-1])
    record_all(lines.numpy(), tuple(map(float, window)), sizes, tuple(detector), rays, frames)
    collect_all(rays, frames, views.flatten(1).numpy(), sizes, tuple(detector), volume)
    return torch.from_numpy(volume).permute(3, 0, 1, 2), rays


@pytest.mark.parametrize("kind", RIGS)
def test_voxels_gather_what_rays_spread(kind):
    torch.manual_seed(0)
    grid, cameras = RIGS[kind]
    lines, window = lines_of(cameras, grid), list(cameras.ray_extent)
    views = torch.randn(2, len(cameras), *cameras.shape, dtype=torch.float64)
    volume, _ = gathered(views, lines, window, grid.shape)
    x = torch.randn(2, *grid.shape, dtype=torch.float64)
    forward = ops.project(x, lines, window, list(cameras.shape), "joseph")
    one, two = (forward * views).sum(), (x * volume).sum()
    assert forward.abs().max() > 0 and torch.isclose(one, two, rtol=1e-12, atol=1e-12)
    expected = ops.backproject(views, lines, window, list(grid.shape), "joseph")
    assert torch.allclose(volume, expected, rtol=0, atol=1e-12 * float(expected.abs().max()))


@pytest.mark.parametrize("kind", ["dome", "wide", "dcspect80"])
def test_the_rigs_have_views_of_several_main_axes(kind):
    """What the test above is for: without such views it would say nothing of them."""
    grid, cameras = RIGS[kind]
    views = torch.ones(1, len(cameras), *cameras.shape, dtype=torch.float64)
    axes = gathered(views, lines_of(cameras, grid), list(cameras.ray_extent), grid.shape)[1][
        7
    ].reshape(len(cameras), -1)
    assert any(len(set(row[row >= 0])) > 1 for row in axes)


@pytest.mark.parametrize("kind", ["cone", "dcspect80", "parallel"])
def test_a_camera_takes_every_point_of_a_ray_to_its_pixel(kind):
    grid, cameras = RIGS[kind]
    lines = lines_of(cameras, grid).numpy()
    for line in lines:
        frame = np.zeros((3, 4))
        projection_matrix(line, frame)
        for p in np.array([[0.0, 0, 1], [1.5, -2, 1], [-3, 0.25, 1]]):
            start, direction = line[2] @ p, line[0] @ p
            for way in (0.3, 1.0, 4.0):
                image = frame @ [*(start + way * direction), 1]
                assert np.allclose(image / image[2], p, rtol=0, atol=1e-9)
