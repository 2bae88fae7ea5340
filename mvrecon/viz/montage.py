"""Montages for review: labelled tiles of planes, views, opinions and weights, every kind of image
with one fixed window of grey values.
"""

from collections.abc import Mapping, Sequence

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from mvrecon.viz.planes import CUBES, Image, Spacing, brightest, grey, middle_planes, signed

GAP = 2
LABEL = 14
CAPTION = 60
EDGE = 128
PLANES = ("across z", "across y", "across x")


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
    ImageDraw.Draw(strip).text((1, 1), text, fill=(255, 255, 255))
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


def planes(
    truth: Float[Tensor, "d h w"],
    volumes: Mapping[str, Float[Tensor, "d h w"]],
    data_range: float,
    spacing: Spacing = CUBES,
) -> Image:
    """Three middle planes (rows) of the truth, of every volume, and of the first volume's error
    (columns).

    Values from 0 to data_range; the error from -data_range / 2 (blue) to data_range / 2 (red). To
    scale: `spacing` is the voxel size along (x, y, z), mm.
    """
    error = next(iter(volumes.values())) - truth
    shown = {"truth": truth, **volumes}
    columns = {
        name: [grey(p, (0, data_range)) for p in middle_planes(v, spacing)]
        for name, v in shown.items()
    }
    columns["error"] = [signed(p, data_range / 2) for p in middle_planes(error, spacing)]
    return _captioned(columns, PLANES)


def slices(volume: Float[Tensor, "d h w"], spacing: Spacing = CUBES) -> Image:
    """The three middle planes of a volume in a row, to scale, from 0 or its least value (black) to
    its greatest.

    Args:
        volume: the values.
        spacing: voxel size along (x, y, z), mm.
    """
    low, high = min(0.0, volume.min().item()), volume.max().item()
    window = low, max(high, low + torch.finfo(torch.float32).tiny)
    images = enlarged([grey(plane, window) for plane in middle_planes(volume, spacing)], 256)
    tall = max(image.shape[0] for image in images)
    padded = [np.pad(i, ((0, tall - i.shape[0]), (0, 0), (0, 0))) for i in images]
    return tiled([[labelled(i, t) for i, t in zip(padded, PLANES, strict=True)]])


def projections(
    truth: Float[Tensor, "d h w"],
    volumes: Mapping[str, Float[Tensor, "d h w"]],
    data_range: float,
    spacing: Spacing = CUBES,
) -> Image:
    """Maximum-intensity projections along three axes (rows) of the truth and of every volume
    (columns), to scale.
    """
    shown = {"truth": truth, **volumes}
    columns = {
        name: [grey(p, (0, data_range)) for p in brightest(v, spacing)] for name, v in shown.items()
    }
    return _captioned(columns, ("along z", "along y", "along x"))


def views(measured: Float[Tensor, "m v u"], predicted: Float[Tensor, "m v u"]) -> Image:
    """Measured and predicted views and their difference (rows) of all cameras (columns).

    Values from 0 to the greatest measured value; the difference to a fourth of it.
    """
    top = max(measured.amax().item(), torch.finfo(torch.float32).tiny)
    columns = {
        f"camera {m}": [grey(y, (0, top)), grey(p, (0, top)), signed(p - y, top / 4)]
        for m, (y, p) in enumerate(zip(measured, predicted, strict=True))
    }
    return _captioned(columns, ("measured", "predicted", "difference"))


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


def opinions(
    volumes: Float[Tensor, "m d h w"], data_range: float, spacing: Spacing = CUBES
) -> Image:
    """Three middle planes (rows) of the mean of the cameras' volumes, and of how every camera's own
    differs from it (columns), to scale.

    The mean from 0 to data_range; a difference from -data_range / 4 (blue) to data_range / 4 (red).
    """
    mean = volumes.mean(dim=0)
    columns = {"mean": [grey(p, (0, data_range)) for p in middle_planes(mean, spacing)]}
    for m, volume in enumerate(volumes):
        planes = middle_planes(volume - mean, spacing)
        columns[f"camera {m}"] = [signed(p, data_range / 4) for p in planes]
    return _captioned(columns, PLANES)


def uncertainty(
    error: Float[Tensor, "d h w"],
    sigma: Float[Tensor, "d h w"],
    data_range: float,
    spacing: Spacing = CUBES,
) -> Image:
    """Three middle planes (rows) of the size of a volume's error and of its expected standard
    deviation (columns), to scale, both from 0 to data_range / 8.
    """
    columns = {
        name: [grey(p, (0, data_range / 8)) for p in middle_planes(v, spacing)]
        for name, v in (("|error|", error.abs()), ("sigma", sigma))
    }
    return _captioned(columns, PLANES)


def weights(volumes: Float[Tensor, "m d h w"], spacing: Spacing = CUBES) -> Image:
    """Three middle planes (rows) of every camera's weight (columns), to scale.

    Values from 0 to 3 / M, so that a camera that counts as much as the others is at one third.
    """
    top = 3 / len(volumes)
    columns = {
        f"camera {m}": [grey(p, (0, top)) for p in middle_planes(v, spacing)]
        for m, v in enumerate(volumes)
    }
    return _captioned(columns, PLANES)


def _captioned(columns: Mapping[str, Sequence[Image]], rows: Sequence[str]) -> Image:
    """Columns of images with their names above and the rows' names on the left, all at one
    scale.
    """
    enlargements = iter(enlarged([image for images in columns.values() for image in images]))
    large = {name: [next(enlargements) for _ in images] for name, images in columns.items()}
    heights = [
        max(0, image.shape[0] - LABEL) for image in next(iter(large.values()))
    ]  # a flat image has less
    names = [np.zeros((height, CAPTION, 3), np.uint8) for height in heights]
    left = [labelled(blank, row) for blank, row in zip(names, rows, strict=True)]
    left[0] = labelled(left[0], "")
    named = [[labelled(first, name), *rest] for name, (first, *rest) in large.items()]
    return tiled(list(zip(left, *named, strict=True)))
