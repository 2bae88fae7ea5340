"""The picture of a rig shows its parts where they are."""

import numpy as np
import pytest
import torch

from mvrecon.geometry.cameras.rigs import circular, parallel
from mvrecon.geometry.grid import Grid
from mvrecon.report.viz.rig import (
    BOX_COLOUR,
    FIRST_COLOUR,
    PANEL_AXES,
    PANEL_BELOW,
    PANEL_EDGE,
    PANEL_LEFT,
    U_COLOUR,
    V_COLOUR,
    picture,
    save_picture,
)

PLATE = {"pixels": [40, 60], "pixel_mm": 4.0}


def of_colour(image: np.ndarray, colour: str) -> np.ndarray:
    """Where an image has a colour."""
    red, green, blue = (int(colour[k : k + 2], 16) for k in (1, 3, 5))
    return (image == (red, green, blue)).all(axis=-1)


def middle(image: np.ndarray, colour: str) -> np.ndarray:
    """The mean column and row of a colour, from the middle of the panel's axes, rows upwards."""
    rows, columns = np.nonzero(of_colour(image, colour))
    right, up = PANEL_LEFT + PANEL_AXES / 2, PANEL_BELOW + PANEL_AXES / 2
    return np.array([columns.mean() - right, PANEL_EDGE - up - rows.mean()])


def test_the_first_view_is_marked_in_its_position():
    """Of a camera at (sid, 0, 0): its columns run along +y and its rows downwards."""
    image = picture(circular(4, 400.0, 800.0, PLATE), Grid.centred(32, spacing=4.0))
    above, side, front = (
        image[:PANEL_EDGE, :PANEL_EDGE],
        image[PANEL_EDGE:, :PANEL_EDGE],
        image[PANEL_EDGE:, PANEL_EDGE:],
    )
    assert middle(above, U_COLOUR)[0] < -100 and abs(middle(front, V_COLOUR)[1]) < 40
    assert (
        middle(front, V_COLOUR)[0] < middle(front, U_COLOUR)[0]
    )  # v starts at the first column, u leads on
    assert middle(front, U_COLOUR)[1] > middle(front, V_COLOUR)[1]  # the first row is the upper one
    for panel in (above, side, front):
        assert np.abs(middle(panel, BOX_COLOUR)).max() < 3


def test_a_flipped_sign_changes_the_picture():
    rig = circular(4, 400.0, 800.0, {**PLATE, "offset_mm": [0.0, 30.0]})
    other = circular(4, 400.0, 800.0, {**PLATE, "offset_mm": [0.0, -30.0]})
    assert (picture(rig) != picture(other)).any(axis=-1).mean() > 0.001


@pytest.mark.parametrize("rig", [parallel(50, PLATE), circular(1, 400.0, 800.0, PLATE)])
def test_pictures_of_any_rig_can_be_saved(rig, tmp_path):
    from PIL import Image

    save_picture(tmp_path / "rig.png", rig.moved(torch.eye(3), torch.tensor([1e4, 0.0, 0.0])))
    image = np.asarray(Image.open(tmp_path / "rig.png"))
    assert of_colour(image, FIRST_COLOUR).sum() > 50
