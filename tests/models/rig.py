"""A small rig for the tests of the models."""

import torch

from mvrecon.cameras.camera import Cameras
from mvrecon.geometry.grid import Grid
from mvrecon.parts import CAMERAS, PROJECTORS


def small_rig(n_views: int = 4, size: int = 12, pixels: int = 12) -> tuple[Grid, Cameras]:
    grid = Grid.centred((size, size, size), 2.0)
    detector = {"pixels": [pixels, pixels], "pixel_mm": 5.0 * size / pixels}
    return grid, CAMERAS.build("circular", n_views=n_views, sid=100.0, sdd=200.0, detector=detector)


def small_projector(n_views: int = 4, **options) -> torch.nn.Module:
    grid, cameras = small_rig(n_views, **options)
    return PROJECTORS.build("drr", grid=grid, cameras=cameras)
