"""A fan of few views over a slice, and what it sees."""

import pytest
import torch

from mvrecon.geometry.grid import Grid
from mvrecon.parts import CAMERAS, PROJECTORS, SCENES


def rig(views: int = 8, size: int = 16):
    """Options of a circle of fans."""
    detector = {"pixels": [1, 2 * size], "pixel_mm": 360 / (2 * size)}
    return {"n_views": views, "sid": 500.0, "sdd": 1000.0, "detector": detector}


def fan(views: int = 8, size: int = 16, slices: int = 1, **options):
    grid = Grid.centred(size=(size, size, slices), spacing=160 / size)
    cameras = CAMERAS.build("circular", **{**rig(views, size), **options})
    return PROJECTORS.build("drr", grid=grid, cameras=cameras)


def stack(views: int = 8, size: int = 16, slices: int = 3):
    """Parallel beams over a stack of slices, a detector row for each of them."""
    grid = Grid.centred(size=(size, size, slices), spacing=160 / size)
    detector = {"pixels": [slices, 2 * size], "pixel_mm": [160 / size, 180 / (2 * size)]}
    cameras = CAMERAS.build("parallel", n_views=views, detector=detector)
    return PROJECTORS.build("radon", grid=grid, cameras=cameras)


@pytest.fixture
def A():
    return fan()


@pytest.fixture
def sample(A):
    return SCENES.build("breast", detail=3).sample(0, 0, A.grid, A.cameras)


@torch.no_grad()
def stirred(model: torch.nn.Module, seed: int = 0) -> torch.nn.Module:
    """With random weights, so that layers that start at zero take part."""
    torch.manual_seed(seed)
    for parameter in model.parameters():
        parameter += 0.1 * torch.randn_like(parameter)
    return model
