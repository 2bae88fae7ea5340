"""Mosaics: sizes, positions and intensity windows."""

import numpy as np
import pytest
import torch

from mvrecon.report.viz import review
from mvrecon.report.viz.review import MOSAIC_WIDTH
from mvrecon.report.viz.sheet import BAR_STRIP, LINE_HEIGHT, ColourScale

#: Pixels above and below the views: text has twice its usual size.
ABOVE, BELOW = 2 * LINE_HEIGHT, 2 * BAR_STRIP


def test_a_mosaic_shows_all_views_in_rows_in_their_order():
    """80 views of one value each are 4 rows of 20 whose greys grow from camera to camera."""
    values = torch.arange(1.0, 81.0)
    image = review.mosaic(values[:, None, None].expand(80, 16, 16), "case", "counts")
    step = MOSAIC_WIDTH // (20 * 17) * 17  # pixels from view to view, a white line between them
    assert image.shape == (ABOVE + 4 * step + BELOW, 20 * step, 3)
    middle = image[ABOVE + step // 2 :: step, step // 2 :: step, 0][:4, :20]
    grey = (255 * values / 80).reshape(4, 20).numpy()  # more than a thousandth is at the maximum
    assert np.abs(middle - grey).max() <= 1
    assert (image[ABOVE : ABOVE + 4 * step, step - 2, 0] == 255).all()


@pytest.mark.parametrize(
    ("shape", "rows"), [((16, 32, 32), 2), ((61, 20, 30), 2), ((7, 8, 8), 1), ((20, 900, 900), 2)]
)
def test_a_mosaic_shows_the_maximum_of_all_views_as_white(shape, rows):
    views = torch.zeros(shape)
    views[-1] = 3.0
    image = review.mosaic(views)
    body = image[ABOVE:-BELOW, :, 0]
    assert MOSAIC_WIDTH // 2 < image.shape[1] <= MOSAIC_WIDTH
    last = np.nonzero((body == 255).mean(axis=1) > 0.9)[0]  # white lines below the rows
    assert len(np.nonzero(np.diff(last, prepend=-9) > 1)[0]) >= rows
    assert review.mosaic(torch.zeros(shape)).shape == image.shape


def test_counts_that_are_scaled_to_the_activity_are_shown_as_counts(monkeypatch):
    monkeypatch.setattr(review, "drawn", lambda layout: layout.tiles[0].panel)
    counts = torch.poisson(torch.full((8, 16, 16), 3.0), generator=torch.Generator().manual_seed(0))
    counts[0, 0, 0] = 100  # a hot pixel does not darken the rest
    panel = review.mosaic(counts * 1.1e-4, unit="spect of activity")
    top = counts.quantile(0.999).item()
    assert top < 20 and panel.scale == ColourScale(0.0, top, "counts")
    panel = review.mosaic(torch.rand(8, 16, 16), unit="spect of activity")
    assert panel.scale.name == "counts (scaled to the activity)"
