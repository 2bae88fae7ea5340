"""The visual hull of CUDA devices, compiled by g++ and run in main memory: brick by brick that of
the CPU.
"""

import pytest
import torch

from mvrecon.kernels.cuda import bricks
from mvrecon.kernels.footprints import Rule
from mvrecon.kernels.rays.cuda import selfcheck
from mvrecon.visual_hull import hull
from tests.kernels.cuda.waits import Waits
from tests.visual_hull.cases import KINDS, random_world


@pytest.mark.parametrize("kind", KINDS)
def test_the_same_bricks_stay(kind, host):
    """In one launch what is told from coarse to fine, for two items, any edge, number of witnesses
    and bricks that nobody sees.
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
                fast = hull.at_once(bright, world.cameras, world.grid, rule, bricks.judge)
            assert waits.names == [] and host.launches == ["judge"]
            assert fast.equal(stays)
            assert hull.at_once(bright, world.cameras, world.grid, rule).equal(stays)
            assert 0 < stays.float().mean() <= 1


def test_a_wrong_hull_is_not_used(host, monkeypatch):
    assert selfcheck.reason("cpu", "hull", tried=hull._tried) is None
    selfcheck.forget()
    right = bricks.judge
    monkeypatch.setattr(bricks, "judge", lambda *arguments: ~right(*arguments))
    assert "hull differs" in str(selfcheck.reason("cpu", "hull", tried=hull._tried))
