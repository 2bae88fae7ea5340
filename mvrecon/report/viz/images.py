"""Grey and coloured images of volumes: middle planes and maximum-intensity projections.

Convention: an image's rows run downwards; planes with the z axis have +z up.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Float, UInt8
from torch import Tensor

from mvrecon.geometry.grid import Grid

Image = UInt8[np.ndarray, "h w 3"]
Window = tuple[float, float]
Spacing = tuple[float, float, float]
CUBES: Spacing = (1.0, 1.0, 1.0)
#: Both directions of the world's axes x, y, z: left, right, posterior, anterior, feet, head.
LETTERS = (("L", "R"), ("P", "A"), ("F", "H"))


class Edges(NamedTuple):
    """Letters of the directions of an image's edges."""

    left: str
    right: str
    top: str
    bottom: str


def middle_planes(
    volume: Float[Tensor, "d h w"], spacing: Spacing = CUBES
) -> list[Float[Tensor, "r c"]]:
    """The three planes through the volume's centre, to scale: across z, across y, across x.

    Args:
        volume: the values.
        spacing: voxel size along (x, y, z), mm; the pixels are squares of the smallest.
    """
    d, h, w = (n // 2 for n in volume.shape)
    return _to_scale([volume[d], volume[:, h], volume[:, :, w]], spacing)


def letters(grid: Grid) -> list[Edges]:
    """Directions at the edges of the planes across z, y and x: L and R, P and A, F and H.

    Convention: the world is the patient's, as in NIfTI: +x to the right (R), +y to the front (A),
    +z to the head (H). Oblique axes get the nearest world axis.
    """
    x, y, z = (_ends(grid.affine[:3, axis]) for axis in range(3))
    return [Edges(*x, *y), Edges(*x, z[1], z[0]), Edges(*y, z[1], z[0])]


def _ends(direction: Float[Tensor, "3"]) -> tuple[str, str]:
    nearest = int(direction.abs().argmax())
    first, last = LETTERS[nearest]
    return (first, last) if direction[nearest] > 0 else (last, first)


def brightest(
    volume: Float[Tensor, "d h w"], spacing: Spacing = CUBES
) -> list[Float[Tensor, "r c"]]:
    """Maximum-intensity projections along z, y and x, to scale; arguments as of `middle_planes`."""
    return _to_scale([volume.amax(dim=axis) for axis in range(3)], spacing)


def _to_scale(
    planes: Sequence[Float[Tensor, "r c"]], spacing: Spacing
) -> list[Float[Tensor, "r c"]]:
    """Images of planes across z, y and x: square pixels, interpolated along longer
    voxels, +z up.
    """
    x, y, z = (step / min(spacing) for step in spacing)
    scaled = []
    for plane, factors in zip(planes, ((y, x), (z, x), (z, y)), strict=True):
        shape = [round(n * factor) for n, factor in zip(plane.shape, factors, strict=True)]
        if shape != list(plane.shape):  # else interpolation would spread non-finite values
            plane = F.interpolate(plane[None, None], shape, mode="bilinear", align_corners=False)[
                0, 0
            ]
        scaled.append(plane)
    return [scaled[0], scaled[1].flip(0), scaled[2].flip(0)]


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


GAP = 2
LABEL = 20
EDGE = 128


def enlarged(images: Sequence[Image], edge: int = EDGE) -> list[Image]:
    """Scale up images by a common factor (at least 1), repeating pixels, up to a longest edge of
    `edge`.
    """
    factor = max(1, edge // max(max(image.shape[:2]) for image in images))
    return [image.repeat(factor, axis=0).repeat(factor, axis=1) for image in images]


def labelled(image: Image, text: str) -> Image:
    """An image under a strip with a text."""
    from PIL import Image as Pillow, ImageDraw

    strip = Pillow.new("RGB", (image.shape[1], LABEL))
    ImageDraw.Draw(strip).text((1, 1), text, fill=(255, 255, 255), font_size=15)
    return np.concatenate([np.asarray(strip), image])


def tiled(rows: Sequence[Sequence[Image]]) -> Image:
    """Tile images in rows and columns on black, each column as wide as its widest image.

    Raises:
        ValueError: no image, or rows of different length.
    """
    if not rows or not rows[0] or len({len(row) for row in rows}) > 1:
        raise ValueError(
            f"A montage needs rows of equal length, got lengths {[len(row) for row in rows]}"
        )
    heights = [max(image.shape[0] for image in row) for row in rows]
    widths = [max(image.shape[1] for image in column) for column in zip(*rows, strict=True)]
    canvas = np.zeros(
        (sum(heights) + GAP * (len(heights) - 1), sum(widths) + GAP * (len(widths) - 1), 3),
        np.uint8,
    )
    top = 0
    for row, height in zip(rows, heights, strict=True):
        left = 0
        for image, width in zip(row, widths, strict=True):
            canvas[top : top + image.shape[0], left : left + image.shape[1]] = image
            left += width + GAP
        top += height + GAP
    return canvas


def radiographs(views: Float[Tensor, "m v u"]) -> list[Image]:
    """The views of all cameras in grey, bright for large line integrals; values from 0 to the
    greatest.
    """
    top = max(views.amax().item(), torch.finfo(torch.float32).tiny)
    return [grey(view, (0, top)) for view in views]


def gallery(views: Float[Tensor, "m v u"], edge: int = 256) -> Image:
    """The views of all cameras in rows of at most four; values from 0 to the greatest."""
    images = [
        labelled(image, f"camera {m}") for m, image in enumerate(enlarged(radiographs(views), edge))
    ]
    images += [np.zeros_like(images[0])] * (-len(images) % min(4, len(images)))
    return tiled([images[i : i + 4] for i in range(0, len(images), 4)])
