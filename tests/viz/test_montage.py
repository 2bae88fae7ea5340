"""Montages: sizes, places and windows of what is shown."""

import numpy as np
import pytest
import torch

from mvrecon.viz import montage
from mvrecon.viz.montage import CAPTION, EDGE, GAP, LABEL

LEFT = CAPTION + GAP


def flat(level, shape=(2, 3)):
    return np.full((*shape, 3), level, np.uint8)


def test_tiles_keep_their_places():
    image = montage.tiled([[flat(10), flat(20)], [flat(30), flat(40)]])
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
        montage.tiled([[flat(1), flat(2)], [flat(3)]])


def test_enlarging_repeats_pixels_equally_in_all_images_and_never_shrinks():
    image = np.arange(12, dtype=np.uint8).reshape(2, 2, 3)
    large, other = montage.enlarged([image, image[:, :1]], 7)
    assert large.shape == (6, 6, 3) and other.shape == (6, 3, 3)
    assert (large[::3, ::3] == image).all()
    assert montage.enlarged([image], 1)[0].shape == image.shape


def test_a_label_writes_above_the_image_only():
    image = montage.labelled(flat(7, (5, 60)), "truth")
    assert image.shape == (5 + LABEL, 60, 3)
    assert image[:LABEL].max() > 128 and (image[LABEL:] == 7).all()


def test_planes_show_truth_ours_baseline_and_signed_error():
    truth = torch.full((96, 96, 96), 0.5)
    image = montage.planes(truth, {"ours": truth + 0.5, "sirt": truth - 0.5}, data_range=1.0)
    side = 96 + GAP
    middle = image[LABEL + 48, LEFT + 48 :: side]
    assert middle.tolist() == [[128] * 3, [255] * 3, [0] * 3, [255, 0, 0]]
    assert image.shape == (LABEL + 3 * 96 + 2 * GAP, LEFT + 4 * 96 + 3 * GAP, 3)


def test_views_of_all_cameras_share_one_window():
    measured = torch.stack([torch.full((96, 96), 1.0), torch.full((96, 96), 2.0)])
    image = montage.views(measured, torch.zeros_like(measured))
    rows = [LABEL + 48, LABEL + 48 + 98, LABEL + 48 + 196]
    assert [image[r, LEFT + 48, 0] for r in rows] == [128, 0, 0]
    assert [image[r, LEFT + 48 + 98, 0] for r in rows] == [255, 0, 0]
    assert image[rows[2], LEFT + 48].tolist() == [0, 0, 255]


def test_equal_weights_are_one_third_grey_for_any_number_of_cameras():
    for count in (2, 5):
        image = montage.weights(torch.full((count, 96, 96, 96), 1 / count))
        assert set(image[LABEL + 48, LEFT + 48 :: 98, 0].tolist()) == {85}


def test_opinions_are_shown_as_differences_from_their_mean():
    """Equal opinions are white beside the mean; what one has more of is red, and less blue."""
    volumes = torch.full((2, 96, 96, 96), 0.5)
    row, columns = LABEL + 48, [LEFT + 48 + 98 * k for k in range(3)]
    image = montage.opinions(volumes, 1.0)
    assert [image[row, c].tolist() for c in columns] == [[128] * 3, [255] * 3, [255] * 3]
    volumes[0] += 0.5  # a fourth more than the mean, and a fourth less
    image = montage.opinions(volumes, 1.0)
    assert [image[row, c].tolist() for c in columns[1:]] == [[255, 0, 0], [0, 0, 255]]


def test_opinions_and_projections_have_a_column_each():
    volumes = torch.rand(5, 8, 8, 8)
    assert montage.opinions(volumes, 1.0).shape[1] == LEFT + 6 * EDGE + 5 * GAP
    assert (
        montage.projections(volumes[0], {"ours": volumes[1]}, 1.0).shape[1] == LEFT + 2 * EDGE + GAP
    )


def test_all_planes_have_one_scale():
    volume, spacing = torch.rand(16, 24, 32), (2.0, 1.0, 4.0)  # a box of 64 x 24 x 64 mm
    heights, width = (48, 128, 128), 128
    expected = (LABEL + sum(heights) + 2 * GAP, LEFT + 2 * width + GAP, 3)
    assert montage.projections(volume, {"ours": volume}, 1.0, spacing).shape == expected
    assert montage.weights(volume[None].repeat(2, 1, 1, 1), spacing).shape == expected


def test_a_gallery_has_rows_of_four_in_order():
    image = montage.gallery(torch.arange(1.0, 7.0)[:, None, None].expand(6, 64, 64), edge=64)
    assert image.shape == (2 * (64 + LABEL) + GAP, 4 * 64 + 3 * GAP, 3)
    middle = image[LABEL + 32 :: 64 + LABEL + GAP, 32 :: 64 + GAP, 0]
    assert middle.tolist() == [[42, 85, 128, 170], [212, 255, 0, 0]]
