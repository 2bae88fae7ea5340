"""Picture of what is wrong with each camera, as it is estimated and as it is."""

import numpy as np
from jaxtyping import Float
from torch import Tensor

from mvrecon.viz.montage import labelled, tiled
from mvrecon.viz.planes import Image

#: Edge of a tile and image pixels of a detector's pixel; radius of a dot.
EDGE, SCALE, DOT = 172, 43, 6
GREY, WHITE, GREEN = (90, 90, 90), (255, 255, 255), (0, 190, 90)


def alignments(
    shift_px: Float[Tensor, "m 2"],
    gain: Float[Tensor, " m"],
    true_shift_px: Float[Tensor, "m 2"] | None = None,
) -> Image:
    """Shift of each camera in pixels as a white dot, its gain as a number, and the true shift as a
    green ring.

    A tile's middle is a camera as it should be, its circle a pixel; shifts beyond the tile lie at
    its edge. At most four tiles a row.

    Args:
        shift_px: estimated, along columns (to the right) and rows (downwards).
        gain: estimated.
        true_shift_px: where it is known.
    """
    truths = [None] * len(gain) if true_shift_px is None else true_shift_px.tolist()
    cameras = zip(shift_px.tolist(), truths, gain.tolist(), strict=True)
    tiles = [
        labelled(_tile(shift, truth), f"{m}: gain {factor:.3f}")
        for m, (shift, truth, factor) in enumerate(cameras)
    ]
    wide = min(4, len(tiles))
    tiles += [np.zeros_like(tiles[0])] * (-len(tiles) % wide)
    return tiled([tiles[i : i + wide] for i in range(0, len(tiles), wide)])


def _tile(shift: list[float], truth: list[float] | None) -> Image:
    from PIL import Image as Pillow
    from PIL import ImageDraw

    tile = Pillow.new("RGB", (EDGE, EDGE))
    draw, middle = ImageDraw.Draw(tile), EDGE // 2
    draw.line((0, middle, EDGE, middle), fill=GREY)
    draw.line((middle, 0, middle, EDGE), fill=GREY)
    draw.circle((middle, middle), SCALE, outline=GREY)
    if truth is not None:
        draw.circle(_place(truth), 2 * DOT, outline=GREEN)
    draw.circle(_place(shift), DOT, fill=WHITE)
    return np.asarray(tile)


def _place(shift: list[float]) -> tuple[float, float]:
    u, v = (min(max(EDGE // 2 + SCALE * one, 0), EDGE - 1) for one in shift)
    return u, v
