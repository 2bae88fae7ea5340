"""Where the patient is."""

import torch

from mvrecon.data.body import body, centre, enclosed, largest_part
from mvrecon.geometry.grid import Grid


def scan(shape=(30, 60, 60)):
    """A trunk with a lung, and a couch behind it."""
    mu = torch.zeros(shape)
    mu[4:28, 12:40, 8:50] = 0.02
    mu[10:20, 20:30, 20:30] = 0.003
    mu[:, 50:52, :] = 0.02
    return mu


def test_the_couch_is_not_the_patient():
    found = body(scan(), 0.005)
    trunk = torch.zeros_like(found)
    trunk[4:28, 12:40, 8:50] = True
    assert torch.equal(found, trunk & (scan() > 0.005))


def test_lungs_are_inside_and_room_air_is_not():
    found = enclosed(body(scan(), 0.005))
    assert found[15, 25, 25] and found.sum() == 24 * 28 * 42


def test_parts_touch_by_faces_only():
    mask = torch.zeros(4, 6, 6, dtype=torch.bool)
    mask[1, 1, 1] = mask[1, 1, 2] = mask[2, 1, 2] = True
    mask[3, 2, 3] = mask[3, 3, 3] = True  # touches the first part by an edge
    assert largest_part(mask).nonzero().tolist() == [[1, 1, 1], [1, 1, 2], [2, 1, 2]]
    assert not largest_part(torch.zeros(2, 2, 2, dtype=torch.bool)).any()


def test_a_winding_part_is_one():
    mask = torch.zeros(1, 9, 9, dtype=torch.bool)
    mask[0, ::2] = True
    mask[0, 1, 8] = mask[0, 3, 0] = mask[0, 5, 8] = mask[0, 7, 0] = True
    assert torch.equal(largest_part(mask), mask)


def test_the_centre_is_that_of_the_box_in_mm():
    mask = torch.zeros(10, 12, 14, dtype=torch.bool)
    mask[2:5, 3:4, 7:13] = True
    grid = Grid.centred(size=(14, 12, 10), spacing=(1.0, 2.0, 3.0), centre=(100.0, 0.0, 0.0))
    assert torch.allclose(
        centre(mask, grid), torch.tensor([103.0, -5.0, -4.5], dtype=torch.float64)
    )


def test_small_and_empty_volumes_pass():
    assert body(torch.ones(2, 2, 2), 0.5).all()
    assert not body(torch.zeros(50, 60, 70), 0.5).any()
    speck = torch.zeros(100, 100, 100)
    speck[50, 50, 50] = 1.0
    assert body(speck, 0.5).nonzero().tolist() == [[50, 50, 50]]
