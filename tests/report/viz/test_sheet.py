"""Sheets: positions, colours and annotations of panels."""

import numpy as np
import pytest
import torch

from mvrecon.report.viz.images import Edges
from mvrecon.report.viz.sheet import (
    BAR_STRIP,
    MAX_TILES,
    SHEET_WIDTH,
    ColourScale,
    Column,
    Panel,
    laid_out,
    sheet,
)

VALUE, ERROR = ColourScale(0.0, 2.0, "value (1/mm)"), ColourScale(-1.0, 1.0, "error")


def flat(level: float, scale: ColourScale = VALUE, edges: Edges | None = None) -> Panel:
    return Panel(torch.full((10, 8), level), scale, edges)


def colour(image: np.ndarray, tile) -> list[int]:
    """The colour a quarter of the way into a tile, where no letter is."""
    return image[int(tile.top + tile.height / 4), int(tile.left + tile.width / 4)].tolist()


def test_panels_have_the_colours_of_their_values_and_each_scale_has_a_bar():
    letters = Edges("L", "R", "P", "A")
    columns = [
        Column("truth", [flat(1.0, edges=letters), None]),
        Column("ours\n30.1  0.91", [flat(2.0), flat(0.5, ERROR)]),
    ]
    rows = ("across z", "error")
    image, layout = sheet("case", columns, rows), laid_out("case", columns, rows)
    assert image.shape == (layout.height, SHEET_WIDTH, 3)
    shown = [colour(image, tile) for tile in layout.tiles]
    np.testing.assert_allclose(shown, [[128] * 3, [255] * 3, [255, 127, 127]], atol=1)
    bars = image[-BAR_STRIP:].reshape(-1, 3)
    assert (bars[:, 0] > bars[:, 2] + 250).any() and (bars[:, 2] > bars[:, 0] + 250).any()
    first = layout.tiles[0]
    inside = image[
        int(first.top) : int(first.top + first.height), int(first.left) : int(SHEET_WIDTH / 2)
    ]
    yellow = (inside[..., 0] > 200) & (inside[..., 2] < 60)
    assert yellow.any(axis=1).sum() > 20 and yellow.any(axis=0).sum() > 20


def test_the_bar_of_negative_values_is_grey_like_their_panel():
    image = sheet("", [Column("", [flat(0.0, ColourScale(-1.0, 3.0, "value"))])], ("",))
    assert (image.max(axis=2) == image.min(axis=2)).all()


@pytest.mark.parametrize(("count", "rows"), [(1, 1), (5, 1), (6, 2), (11, 3)])
def test_columns_wrap_without_overlap(count, rows):
    columns = [Column(f"camera {k}", [flat(0.0)]) for k in range(count)]
    tiles = laid_out("", columns, ("",)).tiles
    assert len({t.top for t in tiles}) == rows and len(tiles) == count
    for row in {t.top for t in tiles}:
        beside = [t for t in tiles if t.top == row]
        ends = [t.left + t.width for t in beside]
        assert len(beside) <= MAX_TILES and max(ends) <= SHEET_WIDTH
        assert all(end < t.left for end, t in zip(ends, beside[1:], strict=False))


def test_panels_share_a_scale_and_letters_are_at_the_first_column():
    edges = Edges("L", "R", "H", "F")
    wide = Panel(torch.zeros(4, 20), VALUE, edges)
    layout = laid_out("", [Column("a", [wide]), Column("b", [flat(0.0, edges=edges)])], ("",))
    zooms = {round(t.width / t.panel.pixels.shape[1], 6) for t in layout.tiles}
    assert len(zooms) == 1
    assert [t.panel.edges for t in layout.tiles] == [edges, None]


def test_columns_without_the_rows_panels_are_refused():
    with pytest.raises(ValueError, match="of 2 rows needs columns of as many, got \\[1\\]"):
        laid_out("", [Column("a", [flat(0.0)])], ("x", "y"))
