"""The visual hull of CUDA devices, compiled by g++ and run in main memory: brick by brick that of
the CPU.
"""

import pytest
import torch

from mvrecon.kernels import self_test
from mvrecon.kernels.cuda import bricks
from mvrecon.kernels.cuda.bricks import Rule
from mvrecon.operators import memo
from mvrecon.operators.visual_hull import hull
from tests.kernels.cuda.waits import Waits
from tests.operators.visual_hull.cases import KINDS, random_world


@pytest.mark.parametrize("kind", KINDS)
def test_the_same_bricks_are_kept(kind, host, monkeypatch):
    """One launch per level from coarse to fine, for two items, any brick edge, number of witnesses,
    and invisible bricks.
    """
    # as on a device, whose values are not compared
    monkeypatch.setattr(memo, "version", lambda tensor: (tensor._version, 0))
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


def test_a_wrong_hull_is_not_used(host, monkeypatch):
    assert self_test.failure("cpu", "hull", torch.float64, hull._self_test) is None
    self_test.forget()
    right = bricks.kept_bricks
    monkeypatch.setattr(bricks, "kept_bricks", lambda *arguments: ~right(*arguments))
    assert "hull differs" in str(self_test.failure("cpu", "hull", torch.float64, hull._self_test))
