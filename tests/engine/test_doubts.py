"""What speaks against a reconstruction is said where it does, and only there."""

from dataclasses import replace

import pytest
import torch

from mvrecon.cameras.rigs import circular, parallel
from mvrecon.data.projections.views import Corrected
from mvrecon.engine.doubts import doubts, reversed_nrmse
from mvrecon.engine.scan import Scan
from mvrecon.geometry.grid import Grid
from mvrecon.projectors.drr import Drr
from mvrecon.projectors.radon import Radon

GRID = Grid.centred(16, spacing=6.0)
RIG = circular(24, 300.0, 450.0, {"pixels": [24, 26], "pixel_mm": 6.0})


class InMemory:
    """Views of a scan that are no files."""

    def __init__(self, views):
        self.views = views

    def read(self, first, last):
        part = self.views[first:last]
        return Corrected(part, torch.ones_like(part, dtype=torch.bool))


@pytest.fixture(scope="module")
def views():
    """Line integrals of two cubes beside each other: no mirror image is the object itself."""
    mu = torch.zeros(1, 1, *GRID.shape)
    mu[..., 6:11, 3:7, 4:11] = 0.02
    mu[..., 4:8, 9:12, 10:13] = 0.04
    return Drr(GRID, RIG)(mu)[0, 0]


def scan_of(views, projector="drr"):
    return Scan(InMemory(views), RIG, GRID, {"name": projector})


def test_a_right_scan_raises_no_doubt(views):
    assert doubts(scan_of(views), "fdk", 0.05) == []


@pytest.mark.door
def test_mirrored_views_and_a_rig_that_turns_the_other_way_are_told(views):
    """A mirrored detector, or a rig that turns the other way, is told with what mends it."""
    figures = reversed_nrmse(scan_of(views.flip(-1)))
    assert figures["columns"] == pytest.approx(reversed_nrmse(scan_of(views))["stored"])
    backwards = replace(scan_of(views), cameras=RIG[[0, *range(23, 0, -1)]])
    for wrong in (scan_of(views.flip(-1)), backwards):
        (words,) = doubts(wrong, "fdk", 0.1)
        assert "columns reversed" in words and "views.flip_columns" in words


@pytest.mark.door
def test_counts_for_line_integrals_and_unexplained_views_are_told(views):
    """Counts taken for line integrals, and a volume that does not explain its views, are told."""
    counts = scan_of((4e4 * torch.exp(-views)).round())
    (words,) = doubts(counts, "fdk", 0.5)
    assert "expected line integrals, got whole numbers up to" in words
    assert "osem" not in "".join(doubts(counts, "osem", 0.1))
    (words,) = doubts(scan_of(views, "of_a_plugin"), "fdk", 0.5)
    assert "does not explain" in words
    (words,) = doubts(scan_of(views, "of_a_plugin"), "osem", 0.5)
    assert "expected counts, got numbers that are not whole" in words
    assert doubts(scan_of(views, "of_a_plugin"), "osem", 0.1) == []


@pytest.mark.parametrize("slices", [1, 12])
def test_parallel_beams_raise_no_doubt_of_their_own(slices):
    """Reversed columns of a parallel scan are those of the object turned by half a circle."""
    rig = parallel(24, {"pixels": [slices, 26], "pixel_mm": [6.0, 6.0]})
    grid = Grid.centred(size=(16, 16, slices), spacing=6.0)
    mu = torch.zeros(1, 1, *grid.shape)
    mu[..., 3:7, 4:11] = 0.02
    mu[..., 9:12, 10:13] = 0.04
    scan = Scan(InMemory(Radon(grid, rig)(mu)[0, 0]), rig, grid, {"name": "radon"})
    assert doubts(scan, "fbp", 0.05) == []
