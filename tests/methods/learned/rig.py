"""A small rig, object and networks for the tests of methods."""

import torch
from torch import nn

from mvrecon.core.parts import CAMERAS, PROJECTORS
from mvrecon.geometry.cameras.camera import Cameras
from mvrecon.geometry.grid import Grid
from mvrecon.methods.method import build_method

#: Options of methods with few weights.
SMALL = {
    "cross_view": {
        "widths": [4, 8],
        "depth_widths": [4],
        "weight_widths": [4],
        "ray_widths": [4, 4],
        "reweight": 0,
        "features": 2,
        "scale": 1,
        "depths": 8,
        "binning": 3,
        "start": 3,
        "consistency": 1,
    },
    "mean_fusion": {"widths": [4], "depths": 8, "start": 3, "consistency": 1},
    "world_unet": {"widths": [4, 8], "start": 3, "consistency": 1},
    "geometry_free": {"n_cameras": 4, "widths": [4, 8]},
}


def small_rig(n_views: int = 4, size: int = 12, pixels: int = 12) -> tuple[Grid, Cameras]:
    grid = Grid.centred((size, size, size), 2.0)
    detector = {"pixels": [pixels, pixels], "pixel_mm": 5.0 * size / pixels}
    return grid, CAMERAS.build("circular", n_views=n_views, sid=100.0, sdd=200.0, detector=detector)


def small_projector(n_views: int = 4, **options) -> torch.nn.Module:
    grid, cameras = small_rig(n_views, **options)
    return PROJECTORS.build("drr", grid=grid, cameras=cameras)


def small(name: str, **options) -> nn.Module:
    """A method with few weights, as before training."""
    torch.manual_seed(0)
    return build_method({"name": name, **SMALL.get(name, {}), **options})


def stirred(name: str, **options) -> nn.Module:
    """The same with random weights everywhere, so that layers that start at zero take part."""
    method = small(name, **options).eval()
    torch.manual_seed(2)
    for parameter in method.parameters():
        parameter.data += 0.1 * torch.randn_like(parameter)
    return method


def blob(A, samples: int = 1) -> torch.Tensor:
    """A box of random values in an empty grid of at least 9 voxels along each axis."""
    random = torch.Generator().manual_seed(1)
    volume = torch.zeros(samples, 1, *A.grid.shape)
    volume[..., 3:9, 4:8, 3:8] = 0.5 + torch.rand(samples, 1, 6, 4, 5, generator=random)
    return volume


def ball(size: int) -> torch.Tensor:
    """A density that falls off smoothly from the centre of a cube of so many voxels."""
    along = torch.linspace(-1, 1, size)
    squares = along[:, None, None] ** 2 + along[:, None] ** 2 + along**2
    return (1 - squares / 0.7).clamp_min(0)[None, None]
