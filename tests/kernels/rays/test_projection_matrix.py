"""A view's matrix takes every point of a ray to the pixel of that ray."""

import numpy as np
import pytest

from mvrecon.geometry.cameras.rigs import dcspect80
from mvrecon.geometry.grid import Grid
from mvrecon.kernels.rays.cpu.footprint import projection_matrix
from mvrecon.kernels.rays.lines import lines_of
from tests.operators.rigs import CONE, GRID, PARALLEL

BODY = Grid.centred(size=(10, 8, 9), spacing=22.0)
RIGS = {
    "cone": (GRID, CONE),
    "parallel": (GRID, PARALLEL),
    "dcspect80": (BODY, dcspect80()[::16].binned(8)),
}


@pytest.mark.parametrize("kind", RIGS)
def test_a_camera_projects_every_point_of_a_ray_to_its_pixel(kind):
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
