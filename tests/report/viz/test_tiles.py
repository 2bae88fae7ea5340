"""Tiles: sizes, places and windows of what is shown."""

import numpy as np
import pytest
import torch

from mvrecon.report.viz import images
from mvrecon.report.viz.images import GAP, LABEL


def flat(level, shape=(2, 3)):
    return np.full((*shape, 3), level, np.uint8)


def test_tiles_keep_their_places():
    image = images.tiled([[flat(10), flat(20)], [flat(30), flat(40)]])
    assert image.shape == (4 + GAP, 6 + GAP, 3)
    assert (
        image[0, 0, 0] == 10
        and image[0, -1, 0] == 20
        and image[-1, 0, 0] == 30
        and image[-1, -1, 0] == 40
    )
    assert (image[2 : 2 + GAP] == 0).all() and (image[:, 3 : 3 + GAP] == 0).all()


def test_ragged_rows_are_refused():
    with pytest.raises(ValueError, match=r"lengths \[2, 1\]"):
        images.tiled([[flat(1), flat(2)], [flat(3)]])


def test_enlarging_repeats_pixels_equally_in_all_images_and_never_shrinks():
    image = np.arange(12, dtype=np.uint8).reshape(2, 2, 3)
    large, other = images.enlarged([image, image[:, :1]], 7)
    assert large.shape == (6, 6, 3) and other.shape == (6, 3, 3)
    assert (large[::3, ::3] == image).all()
    assert images.enlarged([image], 1)[0].shape == image.shape


def test_a_label_writes_above_the_image_only():
    image = images.labelled(flat(7, (5, 60)), "truth")
    assert image.shape == (5 + LABEL, 60, 3)
    assert image[:LABEL].max() > 128 and (image[LABEL:] == 7).all()


def test_a_gallery_has_rows_of_four_in_order():
    image = images.gallery(torch.arange(1.0, 7.0)[:, None, None].expand(6, 64, 64), edge=64)
    assert image.shape == (2 * (64 + LABEL) + GAP, 4 * 64 + 3 * GAP, 3)
    middle = image[LABEL + 32 :: 64 + LABEL + GAP, 32 :: 64 + GAP, 0]
    assert middle.tolist() == [[42, 85, 128, 170], [212, 255, 0, 0]]
