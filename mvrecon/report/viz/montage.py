"""Views as labelled tiles side by side, with one fixed window of grey values."""

from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from mvrecon.report.viz.planes import Image, grey

GAP = 2
LABEL = 20
EDGE = 128


def enlarged(images: Sequence[Image], edge: int = EDGE) -> list[Image]:
    """Images at one scale, each pixel repeated so often that their longest edge stays within `edge`
    (at least once).
    """
    factor = max(1, edge // max(max(image.shape[:2]) for image in images))
    return [image.repeat(factor, axis=0).repeat(factor, axis=1) for image in images]


def labelled(image: Image, text: str) -> Image:
    """The image under a strip that carries a text."""
    from PIL import Image as Pillow
    from PIL import ImageDraw

    strip = Pillow.new("RGB", (image.shape[1], LABEL))
    ImageDraw.Draw(strip).text((1, 1), text, fill=(255, 255, 255), font_size=15)
    return np.concatenate([np.asarray(strip), image])


def tiled(rows: Sequence[Sequence[Image]]) -> Image:
    """Images in rows and columns on black, each column as wide as its widest image.

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
    """The views of all cameras in grey, bright where the line integral is large; values from 0 to
    the greatest of all.
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
