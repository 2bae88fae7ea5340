"""The picture of wrong cameras: dots where the shifts are."""

import numpy as np
import torch

from mvrecon.report.viz.review import (
    DOT_RADIUS,
    GREEN,
    LEGEND_LINE,
    PIXEL_EDGE,
    TILE_EDGE,
    alignments,
)

WHITE = (255, 255, 255)


def centre(image: np.ndarray, colour: tuple[int, int, int]) -> tuple[float, float]:
    """Middle of the pixels of a colour, relative to the tile's, in pixels of a detector."""
    rows, columns = np.nonzero((image == np.array(colour)).all(axis=-1))
    return (columns.mean() - TILE_EDGE / 2) / PIXEL_EDGE, (rows.mean() - TILE_EDGE / 2) / PIXEL_EDGE


def test_dots_mark_shifts_and_rings_the_truth():
    shift, truth = torch.tensor([[0.0, 0.0], [1.0, -0.5]]), torch.tensor([[0.0, 0.0], [0.75, -1.0]])
    image = alignments(shift, torch.ones(2), truth)
    tile = image[-TILE_EDGE:, TILE_EDGE:]
    assert image.shape == (3 * LEGEND_LINE + TILE_EDGE, 2 * TILE_EDGE, 3)
    assert 3 * PIXEL_EDGE + 2 * DOT_RADIUS < TILE_EDGE
    np.testing.assert_allclose(centre(tile, WHITE), (1.0, -0.5), atol=0.05)
    ring = centre(tile, GREEN)
    np.testing.assert_allclose(ring, (0.75, -1.0), atol=0.2)


def test_many_cameras_are_arranged_in_rows_with_large_shifts_inside_the_picture():
    image = alignments(torch.full((10, 2), 99.0), torch.ones(10))
    assert image.shape == (4 * LEGEND_LINE + 3 * TILE_EDGE, 4 * TILE_EDGE, 3)
    assert (image[2 * LEGEND_LINE + TILE_EDGE - 1, TILE_EDGE - 1] == WHITE).all()
