"""Picture of a rig and its grid, from above and from the side, so that a wrong sign is seen."""

from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from mvrecon.core.files.atomic import written_whole
from mvrecon.geometry.cameras.camera import Cameras
from mvrecon.geometry.grid import Grid
from mvrecon.report.viz.montage import labelled, tiled
from mvrecon.report.viz.planes import Image
from mvrecon.report.viz.rig_mesh import box, outlines

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


#: Pixels: a panel's edge, its rim, and the strip of text above it.
EDGE, RIM, STRIP = 560, 46, 34
#: About so many views are drawn.
VIEWS = 24
WHITE, GREY, BLACK = (255, 255, 255), (170, 170, 170), (0, 0, 0)
FIRST, OTHER, BOX, U, V = (200, 30, 30), (120, 150, 200), (0, 110, 60), (230, 120, 0), (150, 0, 170)
#: The parts of a panel: world axes to the right and upwards, and what is seen.
PANELS = (
    (0, 1, "from above (+z towards you)"),
    (0, 2, "from the side, along +y"),
    (1, 2, "from the side, along -x"),
)


class Panel(NamedTuple):
    """A view of the world along one axis.

    Args:
        right, up: indices of the world's axes to the right and upwards.
        centre: what is in the middle, world mm.
        scale: pixels per mm.
    """

    right: int
    up: int
    centre: Float[Tensor, "3"]
    scale: float

    def place(self, xyz: Float[Tensor, "n 3"]) -> list[tuple[float, float]]:
        """Pixels of world points in mm."""
        shift = (xyz - self.centre) * self.scale
        middle = EDGE / 2
        x, y = middle + shift[:, self.right], STRIP + middle - shift[:, self.up]
        return list(zip(x.tolist(), y.tolist(), strict=True))


def picture(cameras: Cameras, grid: Grid | None = None) -> Image:
    """Picture of a rig and a grid in three projections to scale, with axes in mm.

    Sources (pinholes) are dots, detectors outlines; view 0 is red, with its edge rays, and arrows
    from pixel (0, 0) along its columns (u, orange) and rows (v, violet); view 1 has a ring, so that
    the sense of rotation is seen. The grid's box is green. Of many views about `VIEWS` are drawn.

    Args:
        cameras: the rig.
        grid: whose box is drawn; none by default.
    """
    from PIL import Image as Pillow
    from PIL import ImageDraw

    rig = cameras.to("cpu")
    chosen = sorted({0, min(1, len(rig) - 1), *range(0, len(rig), max(1, len(rig) // VIEWS))})
    with torch.no_grad():
        corners, starts = outlines(rig)
    shapes = [(starts[m], corners[m]) for m in chosen]
    points = torch.cat([part for shape in shapes for part in shape])
    if grid is not None:
        points = torch.cat([points, grid.corners()])
    low, high = points.aminmax(dim=0)
    scale = (EDGE - 2 * RIM) / max((high - low).max().item(), 1e-9)
    canvas = Pillow.new("RGB", (EDGE * len(PANELS), EDGE + STRIP), WHITE)
    for number, (right, up, title) in enumerate(PANELS):
        tile = Pillow.new("RGB", (EDGE, EDGE + STRIP), WHITE)
        draw = ImageDraw.Draw(tile)
        panel = Panel(right, up, (low + high) / 2, scale)
        _axes(draw, panel, f"{title}; {len(cameras)} views", low, high)
        for m, shape in reversed(list(zip(chosen, shapes, strict=True))):
            _camera(draw, panel, m, shape)
        if grid is not None:
            _box(draw, panel, grid)
        canvas.paste(tile, (EDGE * number, 0))
    return np.asarray(canvas)


def save_picture(path: str | Path, cameras: Cameras, grid: Grid | None = None) -> None:
    """Write `picture` as a PNG, whole or not at all."""
    from PIL import Image as Pillow

    with written_whole(path) as part:
        Pillow.fromarray(picture(cameras, grid)).save(part, format="PNG")


def _camera(draw, panel: Panel, m: int, shape: tuple[Tensor, Tensor]) -> None:
    starts, corners = shape
    source, outline = panel.place(starts), panel.place(corners)
    colour = FIRST if m == 0 else OTHER
    if m == 0:
        for start, end in zip(source * (4 // len(source)), outline, strict=True):
            draw.line([start, end], fill=GREY)
    draw.line([*outline, outline[0]], fill=colour, width=2 if m == 0 else 1)
    for x, y in source[:1] if len(source) == 1 else source:
        draw.ellipse([x - 3, y - 3, x + 3, y + 3], fill=colour)
    x, y = source[0]
    if m == 1:
        draw.ellipse([x - 7, y - 7, x + 7, y + 7], outline=colour, width=2)
    if m == 0:
        draw.text((x + 6, y - 14), "view 0", fill=FIRST)
        first = corners[0]
        for name, step, hue in (("u", corners[1] - first, U), ("v", corners[3] - first, V)):
            a, b = panel.place(torch.stack([first, first + 0.6 * step]))
            draw.line([a, b], fill=hue, width=4)
            draw.ellipse([b[0] - 4, b[1] - 4, b[0] + 4, b[1] + 4], fill=hue)
            if max(abs(a[0] - b[0]), abs(a[1] - b[1])) > 8:
                draw.text((b[0] + 6, b[1] + 2), name, fill=hue)


def _box(draw, panel: Panel, grid: Grid) -> None:
    for edge in box(grid):
        draw.line(panel.place(edge), fill=BOX, width=2)


def _axes(draw, panel: Panel, title: str, low: Tensor, high: Tensor) -> None:
    """Title, axes through the world's origin where they fit, and marks in round mm."""
    draw.text((8, 8), title, fill=BLACK)
    step = _round_step((high - low).max().item())
    for axis, other, place in ((panel.right, panel.up, 0), (panel.up, panel.right, 1)):
        marks = torch.arange(
            torch.ceil(low[axis] / step).item(), torch.floor(high[axis] / step).item() + 1
        )
        for mark in (marks * step).tolist():
            point = panel.centre.clone()[None]
            point[0, axis] = mark
            x, y = panel.place(point)[0]
            at = (x, EDGE + STRIP - 28) if place == 0 else (8, y - 5)
            end = (x, EDGE + STRIP - 34) if place == 0 else (RIM - 6, y)
            start = (x, EDGE + STRIP - 40) if place == 0 else (RIM - 12, y)
            draw.line([start, end], fill=BLACK)
            draw.text(at, f"{mark:g}", fill=BLACK)
        name = f"{'xyz'[axis]} / mm"
        draw.text(
            (EDGE - 60, EDGE + STRIP - 14) if place == 0 else (8, STRIP - 8), name, fill=BLACK
        )
        zero = torch.zeros(1, 3).to(panel.centre)
        if (low[other] <= 0 <= high[other]).item():
            ends = zero.repeat(2, 1)
            ends[:, axis] = torch.stack([low[axis], high[axis]])
            draw.line(panel.place(ends), fill=GREY)


def _round_step(extent: float) -> float:
    """A round step in mm, 1, 2 or 5 times a power of ten, of which five to ten fit."""
    power = 10.0 ** np.floor(np.log10(max(extent, 1e-9) / 5))
    return float(max(step * power for step in (1, 2, 5) if step * power <= extent / 5))
