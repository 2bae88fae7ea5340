"""The visual hull of CUDA devices and the counts in bricks, compiled by g++ and run in main memory:
brick by brick those of the CPU.
"""

import math

import pytest
import torch

from mvrecon.geometry.grid import bricks_along
from mvrecon.kernels import self_test
from mvrecon.kernels.cuda import bricks
from mvrecon.kernels.cuda.bricks import Rule
from mvrecon.operators.visual_hull import footprints, hull, noise
from mvrecon.operators.visual_hull.footprints import (
    counted,
    counted_at_once,
    prints_of,
    summed_area_tables,
)
from tests.kernels.cuda.waits import Waits
from tests.operators.visual_hull.cases import KINDS, random_world


@pytest.mark.parametrize("kind", KINDS)
def test_the_same_bricks_are_kept(kind, host):
    """One launch per level from coarse to fine, for two items, any brick edge, number of witnesses,
    and invisible bricks.
    """
    for seed, (edge, enough) in enumerate([(1, 2), (3, 1), (4, 3)]):
        world = random_world(kind, seed)
        bright = world.views[:, 0] > 0
        bright = torch.cat([bright, bright.roll(2, dims=-1) & (torch.rand(bright.shape) < 0.9)])
        for keep_unseen in (True, False):
            rule = Rule(edge, hull.REACH, enough, keep_unseen)
            stays = hull.refined(bright, world.cameras, world.grid, rule)
            host.launches.clear()
            with Waits() as waits:
                fast = hull.at_once(bright, world.cameras, world.grid, rule, bricks.kept_bricks)
            assert waits.names == [] and host.launches == ["kept_bricks"]
            assert fast.equal(stays)
            assert hull.at_once(bright, world.cameras, world.grid, rule).equal(stays)
            assert 0 < stays.float().mean() <= 1


@pytest.mark.parametrize("kind", KINDS)
def test_the_same_counts_are_in_every_brick(kind, host):
    """In one launch, of any part of the bricks, of two items; beyond the numbers of 32 bits."""
    for seed, edge in enumerate([1, 3, 4]):
        world = random_world(kind, seed)
        counts = torch.poisson(100 * world.views[:, 0].clamp_min(0))
        table = summed_area_tables(torch.cat([counts, (2**33 * counts).round()]))
        prints = prints_of(world.cameras, world.grid, 0.0)
        size = math.prod(bricks_along(world.grid.shape, edge))
        part = range(size // 5, size - size // 7)
        rest = table, prints, edge, hull.REACH, world.grid.shape, part
        host.launches.clear()
        with Waits() as waits:
            fast = bricks.count(*rest)
        assert waits.names == [] and host.launches == ["count"]
        assert fast.equal(counted(*rest)) and fast.equal(counted_at_once(*rest))
        assert fast.shape == (2, len(world.cameras), len(part)) and fast.max() > 2**32


def test_wrong_counts_are_not_used(host, monkeypatch):
    monkeypatch.setattr(footprints, "counted_at_once", bricks.count)
    assert self_test.failure("cpu", "counts", torch.float64, noise._self_test) is None
    self_test.forget()
    monkeypatch.setattr(
        footprints, "counted_at_once", lambda *arguments: bricks.count(*arguments) + 1
    )
    why = self_test.failure("cpu", "counts", torch.float64, noise._self_test)
    assert "counts differs" in str(why)


def test_a_wrong_hull_is_not_used(host, monkeypatch):
    assert self_test.failure("cpu", "hull", torch.float64, hull._self_test) is None
    self_test.forget()
    right = bricks.kept_bricks
    monkeypatch.setattr(bricks, "kept_bricks", lambda *arguments: ~right(*arguments))
    assert "hull differs" in str(self_test.failure("cpu", "hull", torch.float64, hull._self_test))
