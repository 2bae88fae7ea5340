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
