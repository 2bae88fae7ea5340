"""Where the patient is."""

import pytest
import torch

from mvrecon.data.body import body, body_box, enclosed, largest_part
from mvrecon.data.resample import Slabs
from mvrecon.geometry.grid import Box, Grid


def scan(shape=(30, 60, 60)):
    """A trunk with a lung, and a couch behind it."""
    mu = torch.zeros(shape)
    mu[4:28, 12:40, 8:50] = 0.02
    mu[10:20, 20:30, 20:30] = 0.003
    mu[:, 50:52, :] = 0.02
    return mu


def test_the_couch_is_not_part_of_the_patient():
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


def test_a_winding_component_is_connected():
    mask = torch.zeros(1, 9, 9, dtype=torch.bool)
    mask[0, ::2] = True
    mask[0, 1, 8] = mask[0, 3, 0] = mask[0, 5, 8] = mask[0, 7, 0] = True
    assert torch.equal(largest_part(mask), mask)


def test_the_centre_is_that_of_the_box_in_mm():
    mask = torch.zeros(10, 12, 14, dtype=torch.bool)
    mask[2:5, 3:4, 7:13] = True
    grid = Grid.centred(size=(14, 12, 10), spacing=(1.0, 2.0, 3.0), centre=(100.0, 0.0, 0.0))
    patient = body_box(Slabs.of(mask.float()), 0.5)
    assert patient == Box.around(mask)
    assert torch.allclose(
        grid.cropped(patient).centre, torch.tensor([103.0, -5.0, -4.5], dtype=torch.float64)
    )


def test_small_and_empty_volumes_are_supported():
    assert body(torch.ones(2, 2, 2), 0.5).all()
    assert not body(torch.zeros(50, 60, 70), 0.5).any()
    speck = torch.zeros(100, 100, 100)
    speck[50, 50, 50] = 1.0
    assert body(speck, 0.5).nonzero().tolist() == [[50, 50, 50]]


@pytest.mark.pairwise(seed=range(4), axis=[0, 1, 2])
def test_the_box_of_slabs_is_that_of_the_whole(axis, seed):
    rng = torch.Generator().manual_seed(seed)
    mu = (torch.rand(31, 70, 103, generator=rng) < 0.3 * seed) * 0.01 + scan((31, 70, 103))
    down = [
        (k, mu.narrow(axis, k, min(6, mu.shape[axis] - k))) for k in range(0, mu.shape[axis], 6)
    ][::-1]
    assert body_box(Slabs((31, 70, 103), axis, lambda: iter(down)), 0.005) == Box.around(
        body(mu, 0.005)
    )


def test_the_box_of_nothing_is_empty():
    assert not body_box(Slabs.of(torch.zeros(50, 60, 70)), 0.5).size
