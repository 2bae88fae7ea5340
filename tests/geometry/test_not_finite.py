"""Numbers of a geometry that are not finite, and rigs without views, are refused by name."""

import math
from functools import partial

import pytest
import torch

from mvrecon.geometry.cameras import convert
from mvrecon.geometry.cameras.camera import ExplicitRays
from mvrecon.geometry.cameras.rigs import Detector, circular, dome, parallel
from mvrecon.geometry.grid import Grid
from mvrecon.geometry.rigid import look_at

DETECTOR = {"pixels": [6, 5], "pixel_mm": [2.1, 2.3]}
RIG = circular(2, 40.0, 70.0, DETECTOR)
(K, R, T), SHAPE, CUBE = convert.to_krt(RIG), (6, 5), (4, 4, 4)
START, END = RIG.rays()
krt = partial(convert.from_krt, shape=SHAPE, distance=70.0)
ONES = torch.ones(3)


def spoilt(tensor, bad):
    """A copy whose middle number is bad."""
    copy = tensor.flatten().clone()
    copy[len(copy) // 2] = bad
    return copy.reshape(tensor.shape)


BUILDERS = {
    "centre": lambda bad: Grid.centred(CUBE, 1.0, (0.0, bad, 0.0)),
    "affine": lambda bad: Grid(CUBE, spoilt(torch.eye(4), bad)),
    "pixel_mm": lambda bad: Detector((4, 4), (1.0, bad)),
    "offset_mm": lambda bad: Detector((4, 4), (1.0, 1.0), (bad, 0.0)),
    "K": lambda bad: krt(spoilt(K, bad), R, T),
    "R": lambda bad: krt(K, spoilt(R, bad), T),
    "t": lambda bad: krt(K, R, spoilt(T, bad)),
    "P": lambda bad: convert.from_matrix(spoilt(RIG.matrix, bad), SHAPE, 70.0),
    "ASTRA": lambda bad: convert.from_astra(spoilt(convert.to_astra(RIG), bad), SHAPE),
    "target": lambda bad: ExplicitRays(START, spoilt(END, bad)),
    "finite": lambda bad: look_at(ONES, torch.full((3,), bad)),
    "up": lambda bad: look_at(ONES, -ONES, (0.0, bad, 1.0)),
}


@pytest.mark.parametrize("name", BUILDERS)
def test_numbers_that_are_not_finite_are_named(name):
    for bad in (math.nan, math.inf, -math.inf):
        with pytest.raises(ValueError, match=rf"\b{name}\b"):
            BUILDERS[name](bad)


def test_rigs_without_views_are_refused():
    for build in (
        lambda: parallel(0, DETECTOR, 60.0),
        lambda: dome(0, 30.0, 20.0, 120.0, DETECTOR),
        lambda: ExplicitRays(torch.zeros(1, 1, 0, 3), torch.zeros(1, 1, 0, 3)),
    ):
        with pytest.raises(ValueError):
            build()
