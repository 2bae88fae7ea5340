"""Checks that every network and every head of a learned method must pass."""

from typing import Any

import torch

from mvrecon.core.parts import HEADS
from mvrecon.methods.learned.baselines import network_by_name
from mvrecon.methods.learned.view_frames import Frusta
from mvrecon.testing.method import check_gradients
from mvrecon.testing.projector import close

#: Relative, of float32 sums of some thousand products a voxel.
TOLERANCE = 1e-5


def check_network(name: str, seed: int = 0, **options: Any) -> None:
    """Raise AssertionError unless the named network can serve in a method.

    A finite answer of the input's size, odd sizes included unless the network names a `multiple`;
    a start at zero where it is asked for; in evaluation the same bits when it is called twice, and
    a sample's answer that does not depend on the others; gradients that reach every parameter.

    Args:
        name: of the network.
        seed: of weights and input.
        options: of the network.
    """
    torch.manual_seed(seed)
    network = network_by_name({"name": name, **options}, 2, 3, zero=1).eval()
    x = torch.randn(2, 2, 9, 4, 6)
    with torch.no_grad():
        answer = network(x)
        assert not answer[:, :1].any(), "an output that starts at zero is not zero"
        assert answer[:, 1:].any(), "outputs that need not start at zero are all zero"
        for parameter in network.parameters():
            parameter += 0.05 * torch.randn_like(parameter)
        answer = network(x)
        assert answer.isfinite().all(), "the answer is not finite"
        assert torch.equal(network(x), answer), "not the same bits when called twice"
        assert close(network(x[1:]), answer[1:], TOLERANCE), (
            "an answer depends on the others of its batch"
        )
    check_gradients(network, network(x))


def check_head(name: str, frusta: Frusta, seed: int = 0, **options: Any) -> None:
    """Raise AssertionError unless the named head keeps its promises in these frusta.

    A density of the right shape; finite even where rays miss; nothing outside the region; and,
    of a head with `keeps_views`, the measured views for any logits and prior: nothing on rays that
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
