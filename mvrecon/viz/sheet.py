"""A sheet of images with names, letters of directions and colour bars, drawn with matplotlib.

A sheet is as wide as suits TensorBoard, whose cards show it at half its size: `TEXT` stays legible.
"""

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from jaxtyping import Float
from torch import Tensor

from mvrecon.viz.planes import Edges, Image, grey, signed

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

#: Pixels: a sheet's width, strip of the rows' names, gap between tiles, a line of text, the strip
#: of the colour bars, and the size of letters.
WIDTH, STRIP, GAP, LINE, BARS, TEXT = 700, 24, 4, 22, 66, 17
#: The most tiles in a row, and a tile's greatest height by its width.
ACROSS, TALL = 5, 1.5
DPI, BLACK, WHITE = 100, "#101010", "white"


class Scale(NamedTuple):
    """Values that an image's colours stand for: grey from low to high, or, where low = -high, blue,
    white and red.

    Args:
        low, high: ends, in the unit that the name tells.
        name: what is shown, with its unit.
    """

    low: float
    high: float
    name: str

    def painted(self, pixels: Float[Tensor, "r c"]) -> Image:
        """Colours of values."""
        if self.low == -self.high:
            return signed(pixels, self.high)
        return grey(pixels, (self.low, self.high))


class Panel(NamedTuple):
    """One image, its colours, and the letters at its edges."""

    pixels: Float[Tensor, "r c"]
    scale: Scale
    edges: Edges | None = None


class Column(NamedTuple):
    """Images below one another (None: left out) under a name of one line or more."""

    name: str
    panels: Sequence[Panel | None]


class Tile(NamedTuple):
    """Where a panel lies on the sheet, in pixels from the upper left."""

    panel: Panel
    left: float
    top: float
    width: float
    height: float


class Text(NamedTuple):
    """Words on the sheet: middle of their line's left end, centre, or, upright, their middle."""

    words: str
    x: float
    y: float
    at: str = "center"
    upright: bool = False


class Layout(NamedTuple):
    """All that is on a sheet, and the sheet's height in pixels, with the colour bars at its end."""

    tiles: list[Tile]
    texts: list[Text]
    height: int


def laid_out(title: str, columns: Sequence[Column], rows: Sequence[str]) -> Layout:
    """The places of panels and words: columns side by side, at most `ACROSS`, then below; letters
    stay at the first of a row.

    Raises:
        ValueError: no column, or columns that have not the rows' number of panels.
    """
    lengths = [len(column.panels) for column in columns]
    if not columns or set(lengths) != {len(rows)}:
        raise ValueError(f"A sheet of {len(rows)} rows needs columns of as many, got {lengths}")
    lines = math.ceil(len(columns) / ACROSS)
    across = max(2, math.ceil(len(columns) / lines))
    wide = (WIDTH - STRIP) / across - GAP
    shapes = [p.pixels.shape for column in columns for p in column.panels if p is not None]
    zoom = min(wide / max(s[1] for s in shapes), TALL * wide / max(s[0] for s in shapes))
    tiles, texts, top = [], [Text(title, GAP, LINE / 2, "left")], float(LINE)
    for first in range(0, len(columns), across):
        block = columns[first : first + across]
        lefts = [STRIP + k * (wide + GAP) for k in range(len(block))]
        names = [column.name.splitlines() for column in block]
        for left, words in zip(lefts, names, strict=True):
            texts += [
                Text(line, left + wide / 2, top + (k + 0.5) * LINE) for k, line in enumerate(words)
            ]
        top += LINE * max(map(len, names))
        for k, row in enumerate(rows):
            panels = [column.panels[k] for column in block]
            height = zoom * max((p.pixels.shape[0] for p in panels if p is not None), default=0)
            texts.append(Text(row, STRIP / 2, top + height / 2, upright=True))
            for left, panel in zip(lefts, panels, strict=True):
                if panel is not None:
                    tall, width = (zoom * n for n in panel.pixels.shape)
                    shown = panel if left == lefts[0] else panel._replace(edges=None)
                    tiles.append(Tile(shown, left + (wide - width) / 2, top, width, tall))
            top += height + GAP
    return Layout(tiles, texts, round(top) + BARS)


def sheet(title: str, columns: Sequence[Column], rows: Sequence[str]) -> Image:
    """Image of the panels with their names above, letters of directions at the edges of the first
    column, and a colour bar for every scale.

    Args:
        title: a line above all.
        columns: one for each method or camera.
        rows: what is below one another.

    Raises:
        ValueError: see `laid_out`.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    layout = laid_out(title, columns, rows)
    figure = Figure((WIDTH / DPI, layout.height / DPI), dpi=DPI, facecolor=BLACK)
    canvas, axes = FigureCanvasAgg(figure), figure.add_axes((0, 0, 1, 1))
    axes.set(xlim=(0, WIDTH), ylim=(layout.height, 0), autoscale_on=False)
    axes.axis("off")
    size = TEXT * 72 / DPI
    for tile in layout.tiles:
        right, bottom = tile.left + tile.width, tile.top + tile.height
        axes.imshow(
            tile.panel.scale.painted(tile.panel.pixels),
            extent=(tile.left, right, bottom, tile.top),
            aspect="auto",
        )
    for text in layout.texts:
        axes.text(
            *(text.x, text.y, text.words),
            color=WHITE,
            fontsize=size,
            ha=text.at,
            va="center",
            rotation=90 if text.upright else 0,
        )
    for tile in layout.tiles:
        if tile.panel.edges is not None:
            _letters(axes, tile, tile.panel.edges, size)
    scales = list(dict.fromkeys(tile.panel.scale for tile in layout.tiles))
    for k, scale in enumerate(scales):
        _bar(figure, scale, (k / len(scales), 1 / len(scales)), layout.height)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3].copy()


def _letters(axes: "Axes", tile: Tile, edges: Edges, size: float) -> None:
    middle = tile.left + tile.width / 2, tile.top + tile.height / 2
    right, bottom = tile.left + tile.width - 2, tile.top + tile.height - 2
    places = (
        (edges.left, tile.left + 2, middle[1], "left", "center"),
        (edges.right, right, middle[1], "right", "center"),
        (edges.top, middle[0], tile.top + 2, "center", "top"),
        (edges.bottom, middle[0], bottom, "center", "bottom"),
    )
    for letter, x, y, ha, va in places:
        axes.text(x, y, letter, color="#f0a000", fontsize=size, ha=ha, va=va)


def _bar(figure: "Figure", scale: Scale, place: tuple[float, float], height: int) -> None:
    """A colour bar at the sheet's lower end, from a fraction of its width on."""
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize

    first, share = place
    box = (first + 0.08 * share, 46 / height, 0.84 * share, 12 / height)
    bar = figure.colorbar(
        ScalarMappable(Normalize(scale.low, scale.high), "bwr" if scale.low < 0 else "gray"),
        cax=figure.add_axes(box),
        orientation="horizontal",
        ticks=[scale.low, (scale.low + scale.high) / 2, scale.high],
        format="%.3g",
    )
    size = 0.9 * TEXT * 72 / DPI
    bar.ax.tick_params(colors=WHITE, labelsize=size, length=3, pad=1)
    least, _, most = bar.ax.get_xticklabels()  # long numbers stay between the bar's ends
    least.set_horizontalalignment("left")
    most.set_horizontalalignment("right")
    bar.set_label(scale.name, color=WHITE, fontsize=size, labelpad=0)
    bar.outline.set_edgecolor(WHITE)  # pyright: ignore[reportCallIssue]
