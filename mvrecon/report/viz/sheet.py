"""Sheets of panels: images in columns and rows with names, letters of directions at their edges, a
scale bar in mm and a colour bar for every scale.
"""

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from jaxtyping import Float
from torch import Tensor

from mvrecon.report.viz import images

if TYPE_CHECKING:
    from matplotlib.figure import Figure


#: Pixels: a sheet's width, strip of row names, gap between tiles, line of text, strip of colour
#: bars, size of letters.
SHEET_WIDTH, NAME_STRIP, TILE_GAP, LINE_HEIGHT, BAR_STRIP, LETTER_SIZE = 700, 24, 4, 22, 66, 17
#: Maximum tiles in a row, and a tile's greatest aspect ratio, height by width.
MAX_TILES, MAX_ASPECT = 5, 1.5
DPI, BLACK, WHITE, MARK = 100, "#101010", "white", "#f0a000"


class ColourScale(NamedTuple):
    """A colour scale: grey from low to high, or, if low = -high, blue, white and red.

    Args:
        low, high: ends, in the unit within the name.
        name: quantity with its unit.
        mark: value with a line across the colour bar; None: no line.
    """

    low: float
    high: float
    name: str
    mark: float | None = None

    def painted(self, pixels: Float[Tensor, "r c"]) -> images.Image:
        """Map values to colours."""
        if self.low == -self.high:
            return images.signed(pixels, self.high)
        return images.grey(pixels, (self.low, self.high))


class Panel(NamedTuple):
    """An image, its colour scale, the letters at its edges, the width of a pixel in mm, and its
    name.
    """

    pixels: Float[Tensor, "r c"]
    scale: ColourScale
    edges: images.Edges | None = None
    mm: float | None = None
    name: str = ""


class Column(NamedTuple):
    """Images in a column (None: empty) under a name of one or more lines."""

    name: str
    panels: Sequence[Panel | None]


class Tile(NamedTuple):
    """Position of a panel on the sheet, in pixels from the upper left."""

    panel: Panel
    left: float
    top: float
    width: float
    height: float


class Layout(NamedTuple):
    """Contents of a sheet: panels, texts as arguments of matplotlib's `Axes.text`, its height in
    pixels including colour bars, its width, the length of its scale bar or 0, and the image's zoom.
    """

    tiles: list[Tile]
    texts: list[dict[str, Any]]
    height: float
    width: float = SHEET_WIDTH
    ruler: float = 0.0
    zoom: int = 1


def laid_out(title: str, columns: Sequence[Column], rows: Sequence[str]) -> Layout:
    """Place panels and texts: at most `MAX_TILES` columns side by side, then below; letters where
    they differ from those of the panel to the left; a scale bar where the panels' pixels are in mm.

    Raises:
        ValueError: no column, or columns of other length than the rows.
    """
    lengths = [len(column.panels) for column in columns]
    if not columns or set(lengths) != {len(rows)}:
        raise ValueError(f"A sheet of {len(rows)} rows needs columns of as many, got {lengths}")
    lines = math.ceil(len(columns) / MAX_TILES)
    across = max(2, math.ceil(len(columns) / lines))
    wide = (SHEET_WIDTH - NAME_STRIP) / across - TILE_GAP
    shapes = [p.pixels.shape for column in columns for p in column.panels if p is not None]
    zoom = min(wide / max(s[1] for s in shapes), MAX_ASPECT * wide / max(s[0] for s in shapes))
    tiles, top = [], float(LINE_HEIGHT)
    texts: list[dict[str, Any]] = [{"s": title, "x": TILE_GAP, "y": LINE_HEIGHT / 2, "ha": "left"}]
    for first in range(0, len(columns), across):
        block = columns[first : first + across]
        lefts = [NAME_STRIP + k * (wide + TILE_GAP) for k in range(len(block))]
        names = [column.name.splitlines() for column in block]
        for left, words in zip(lefts, names, strict=True):
            texts += [
                {"s": line, "x": left + wide / 2, "y": top + (k + 0.5) * LINE_HEIGHT}
                for k, line in enumerate(words)
            ]
        top += LINE_HEIGHT * max(map(len, names))
        for k, row in enumerate(rows):
            panels = [column.panels[k] for column in block]
            height = zoom * max((p.pixels.shape[0] for p in panels if p is not None), default=0)
            texts.append({"s": row, "x": NAME_STRIP / 2, "y": top + height / 2, "rotation": 90})
            drawn_edges = None
            for left, panel in zip(lefts, panels, strict=True):
                if panel is not None:
                    tall, width = (zoom * n for n in panel.pixels.shape)
                    shown = panel._replace(edges=None) if panel.edges == drawn_edges else panel
                    drawn_edges = panel.edges
                    tiles.append(Tile(shown, left + (wide - width) / 2, top, width, tall))
            top += height + TILE_GAP
    mm, ruler = tiles[0].panel.mm, 0.0
    if mm is not None:
        length = _round_number(mm * wide / zoom / 2)
        ruler = zoom * length / mm
        place = {"x": SHEET_WIDTH - 4 * TILE_GAP - ruler, "y": LINE_HEIGHT / 2, "ha": "right"}
        texts.append({"s": f"{length:g} mm", **place})
    return Layout(tiles, texts, round(top) + BAR_STRIP, ruler=ruler)


def _round_number(most: float) -> float:
    """The greatest of 1, 2 and 5 times a power of ten up to `most`."""
    power = 10.0 ** math.floor(math.log10(most))
    return power * max(step for step in (1, 2, 5) if step * power <= most)


def sheet(title: str, columns: Sequence[Column], rows: Sequence[str]) -> images.Image:
    """Draw panels with names above, letters of directions at their edges, a scale bar in mm, and a
    colour bar for every scale.

    Args:
        title: top line.
        columns: one for each method or camera.
        rows: names of the rows.

    Raises:
        ValueError: see `laid_out`.
    """
    return drawn(laid_out(title, columns, rows))


def drawn(layout: Layout) -> images.Image:
    """Image of a layout."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from matplotlib.patheffects import withStroke

    inches = (layout.width / DPI, layout.height / DPI)
    figure = Figure(inches, dpi=layout.zoom * DPI, facecolor=BLACK)
    canvas, axes = FigureCanvasAgg(figure), figure.add_axes((0, 0, 1, 1))
    axes.set(xlim=(0, layout.width), ylim=(layout.height, 0), autoscale_on=False)
    axes.axis("off")
    size = LETTER_SIZE * 72 / DPI
    for tile in layout.tiles:
        right, bottom = tile.left + tile.width, tile.top + tile.height
        axes.imshow(
            tile.panel.scale.painted(tile.panel.pixels),
            extent=(tile.left, right, bottom, tile.top),
            aspect="auto",
        )
    style: dict[str, Any] = {"color": WHITE, "fontsize": size, "ha": "center", "va": "center"}
    for text in layout.texts:
        axes.text(**(style | text))
    for tile in layout.tiles:
        if (edges := tile.panel.edges) is not None:
            x, y = tile.left + tile.width / 2, tile.top + tile.height / 2
            right, bottom = tile.left + tile.width - 2, tile.top + tile.height - 2
            for letter, at, down, ha, va in (
                (edges.left, tile.left + 2, y, "left", "center"),
                (edges.right, right, y, "right", "center"),
                (edges.top, x, tile.top + 2, "center", "top"),
                (edges.bottom, x, bottom, "center", "bottom"),
            ):
                mark = axes.text(at, down, letter, color=MARK, fontsize=size, ha=ha, va=va)
                mark.set_path_effects([withStroke(linewidth=2, foreground=BLACK)])  # on bone, too
    if layout.ruler:
        end = layout.width - TILE_GAP
        axes.plot([end - layout.ruler, end], [LINE_HEIGHT / 2] * 2, color=WHITE, linewidth=3)
    scales = list(dict.fromkeys(tile.panel.scale for tile in layout.tiles))
    for k, scale in enumerate(scales):
        _bar(figure, scale, (k / len(scales), 1 / len(scales)), layout.height)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3].copy()


def _bar(figure: "Figure", scale: ColourScale, place: tuple[float, float], height: float) -> None:
    """Draw a colour bar at the sheet's lower end, from a fraction of its width."""
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize
    from matplotlib.ticker import MaxNLocator

    first, share = place
    box = (first + 0.08 * share, 46 / height, 0.84 * share, 12 / height)
    signed = scale.low == -scale.high  # as `ColourScale.painted`
    bar = figure.colorbar(
        ScalarMappable(Normalize(scale.low, scale.high), "bwr" if signed else "gray"),
        cax=figure.add_axes(box),
        orientation="horizontal",
        ticks=MaxNLocator(4, steps=[1, 2, 2.5, 5, 10]),
        format="%g",
    )
    size = 0.9 * LETTER_SIZE * 72 / DPI
    bar.ax.tick_params(colors=WHITE, labelsize=size, length=3, pad=1)
    bar.set_label(scale.name, color=WHITE, fontsize=size, labelpad=0)
    bar.outline.set_edgecolor(WHITE)
    if scale.mark is not None:
        bar.ax.axvline(scale.mark, color=MARK, linewidth=3)
