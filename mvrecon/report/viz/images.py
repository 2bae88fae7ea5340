"""Grey and coloured images of volumes: planes and maximum-intensity projections.

Convention: the world is the patient's, as in NIfTI: +x to the right (R), +y to the front (A), +z to
the head (H). Images are radiological: H, else A, at the top, and R, else A, on the left.
"""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Float, UInt8
from torch import Tensor

from mvrecon.core.files.atomic import written_whole
from mvrecon.geometry.cameras.camera import Cameras
from mvrecon.geometry.cameras.field import sees
from mvrecon.geometry.grid import Grid, coarse, voxel_centres
from mvrecon.kernels.operator import to_accumulation_dtype

Image = UInt8[np.ndarray, "h w 3"]
Window = tuple[float, float]
#: Both directions of the world's axes x, y, z: left, right, posterior, anterior, feet, head.
AXIS_LETTERS = (("L", "R"), ("P", "A"), ("F", "H"))
#: Blocks along the longest side that `content` averages, and the most views that it considers.
MAX_BLOCKS = 32


class Edges(NamedTuple):
    """Letters of the directions of an image's edges."""

    left: str
    right: str
    top: str
    bottom: str


class Plane(NamedTuple):
    """An image of a volume, the letters at its edges, and its name, such as "z = 12 mm"."""

    pixels: Float[Tensor, "r c"]
    edges: Edges
    name: str


@torch.no_grad()
def content(
    volume: Float[Tensor, "d h w"], grid: Grid, cameras: Cameras | None = None
) -> Float[Tensor, "3"]:
    """The centre of mass in world mm of the values in the upper half of their range.

    Args:
        volume: values in any unit.
        grid: grid of the volume.
        cameras: restrict it to the voxels in the field of view of the most views, such as the
            heart at which pinholes aim, without the liver. None: all voxels.
    """
    blocks = coarse(grid, MAX_BLOCKS)
    values = to_accumulation_dtype(volume.detach().cpu())[None]
    values = F.adaptive_avg_pool3d(values, blocks.shape).flatten().double()
    values, points = values.nan_to_num(), voxel_centres(blocks).reshape(-1, 3)
    if cameras is not None:
        views = cameras[:: -(-len(cameras) // MAX_BLOCKS)].to("cpu")
        count = sees(views, points.to(views.source)).sum(dim=0)
        values, points = values[count == count.max()], points[count == count.max()]
    low, high = values.quantile(values.new_tensor([0.01, 0.99]))
    mass = (values - low) * (values > (low + high) / 2)
    return mass @ points / mass.sum() if mass.any() else grid.centre


def planes(
    volume: Float[Tensor, "d h w"], grid: Grid, centre: Float[Tensor, "3"] | None = None
) -> list[Plane]:
    """The planes across the volume's axes z, y and x through a point, to scale.

    Args:
        volume: the values.
        grid: grid of the volume; its voxels may be finer or coarser.
        centre: the point in world mm, rounded to a voxel; None: the grid's centre.
    """
    at = grid.to_index(grid.centre if centre is None else centre) + 0.5
    point = grid.to_world(at.floor()).tolist()
    ratio = at.new_tensor(volume.shape[::-1]) / at.new_tensor(grid.size)
    x, y, z = (at * ratio).int().tolist()
    return _to_scale(
        [volume[z], volume[:, y], volume[:, :, x]],
        grid,
        lambda axis: f"{'xyz'[axis]} = {round(point[axis], 6) + 0.0:.4g} mm",  # + 0.0: no -0
    )


def brightest(volume: Float[Tensor, "d h w"], grid: Grid) -> list[Plane]:
    """Maximum-intensity projections along z, y and x, to scale; arguments as in `planes`."""
    shown = [volume.amax(dim=axis) for axis in range(3)]
    return _to_scale(shown, grid, lambda axis: f"along {'xyz'[axis]}")


def _to_scale(
    images: Sequence[Float[Tensor, "r c"]], grid: Grid, name: Callable[[int], str]
) -> list[Plane]:
    """Radiological images with square pixels, interpolated along longer voxels, of those across
    z, y and x; oblique axes count as the nearest of the world.
    """
    steps = [step / min(grid.spacing) for step in grid.spacing]
    world = grid.affine[:3, :3].abs().argmax(dim=0).tolist()
    shown = []
    for across, image in zip((2, 1, 0), images, strict=True):
        axes = [axis for axis in (2, 1, 0) if axis != across]
        shape = [round(n * steps[axis]) for n, axis in zip(image.shape, axes, strict=True)]
        if shape != list(image.shape):  # else interpolation would spread non-finite values
            image = F.interpolate(image[None, None], shape, mode="bilinear", align_corners=False)[
                0, 0
            ]
        if world[axes[0]] < world[axes[1]]:
            image, axes = image.T, axes[::-1]
        ends = [k for k, axis in enumerate(axes) if grid.affine[world[axis], axis] > 0]
        (bottom, top), (right, left) = (AXIS_LETTERS[world[axis]] for axis in axes)
        edges = Edges(left, right, top, bottom)
        shown.append(Plane(image.flip(ends), edges, name(world[across])))
    return shown


def grey(image: Float[Tensor, "h w"], window: Window) -> Image:
    """A grey image: black at the window's lower end, white at its upper; non-finite values are red.

    Raises:
        ValueError: a window in descending order.
    """
    low, high = window
    if not low < high:
        raise ValueError(f"A window of values needs its lower end below its upper, got {window}")
    values = image.detach().cpu().double()
    level = ((values - low) / (high - low)).clamp(0, 1).nan_to_num(0)
    colours = (level[..., None] * 255).round().to(torch.uint8).expand(-1, -1, 3).clone()
    colours[~values.isfinite()] = torch.tensor([255, 0, 0], dtype=torch.uint8)
    return colours.numpy()


def signed(image: Float[Tensor, "h w"], limit: float) -> Image:
    """A signed image: white at 0, red towards +limit, blue towards -limit.

    Raises:
        ValueError: a limit that is not positive.
    """
    if not limit > 0:
        raise ValueError(f"A signed image needs a positive limit, got {limit}")
    level = (image.detach().cpu().double() / limit).clamp(-1, 1).nan_to_num(0)
    red, blue = 1 - (-level).clamp(min=0), 1 - level.clamp(min=0)
    colours = torch.stack([red, 1 - level.abs(), blue], dim=-1)
    return (colours * 255).round().to(torch.uint8).numpy()


def save_png(path: str | Path, image: Image) -> None:
    """Write an image; an existing file is replaced atomically."""
    from PIL import Image as Pillow

    with written_whole(path) as part:
        Pillow.fromarray(image).save(part, format="PNG")
