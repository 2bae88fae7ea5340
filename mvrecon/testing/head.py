"""Checks that every head must pass."""

from typing import Any

import torch

from mvrecon.core.parts import HEADS
from mvrecon.methods.learned.view_frames import Frusta


def check_head(name: str, frusta: Frusta, seed: int = 0, **options: Any) -> None:
    """Raise AssertionError unless the named head keeps its promises in these frusta.

    A density of the right shape; finite even where rays miss; nothing outside the region; and,
    where `keeps_views` says so, the measured views for any logits and prior: nothing on rays that
    measured nothing.
    """
    torch.manual_seed(seed)
    head = HEADS.build(name, **options)
    depth, v, u = frusta.shape
    m = len(frusta.slant)
    views = torch.rand(2, 1, m, v, u) * (frusta.chord.reshape(1, 1, m, v, u) > 0)
    views[..., : u // 3] = 0
    logits, prior = 3 * torch.randn(2, m, 1, depth, v, u), torch.rand(2, m, 1, depth, v, u)
    density = head(logits, prior, views, frusta)
    assert density.shape == logits.shape, (
        f"density is {tuple(density.shape)}, logits are {tuple(logits.shape)}"
    )
    assert density.isfinite().all(), "density is not finite"
    assert not (density * ~frusta.occupied).any(), "density outside the region of interest"
    if head.keeps_views:
        error = (frusta.integrate(density) - views).abs().max() / views.max()
        assert error < 1e-5, f"own views are missed by {error:.2g} of their maximum"
