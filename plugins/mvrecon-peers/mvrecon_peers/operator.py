"""A peer as a custom torch operator, for `torch.compile`, autocast, vmap and derivatives."""

from collections.abc import Callable
from itertools import count
from typing import Any
from weakref import WeakValueDictionary

import torch
from torch import Tensor

_PEERS: WeakValueDictionary[int, Any] = WeakValueDictionary()
_KEYS = count()


def known_by(peer: Any) -> int:
    """Register a peer under a number, by which `linear` finds it while it exists: operators do not
    accept objects.
    """
    key = next(_KEYS)
    _PEERS[key] = peer
    return key


@torch.library.custom_op("mvrecon_peers::linear", mutates_args=())
def linear(operand: Tensor, key: int, back: bool) -> Tensor:
    """Project volumes [n d h w] to views [n m v u] with a peer, or back-project."""
    peer = _PEERS[key]
    act: Callable[[Tensor], Tensor] = peer.backproject if back else peer.project
    result = operand.new_empty(operand.shape[0], *peer.sizes(back))
    with torch.autocast(operand.device.type, enabled=False):
        for one, out in zip(operand, result, strict=True):
            out.copy_(act(one.contiguous()))
    return result


@linear.register_fake
def _(operand, key, back):
    return operand.new_empty(operand.shape[0], *_PEERS[key].sizes(back))


def _keep(ctx, inputs, output):
    _, ctx.key, ctx.back = inputs
    ctx.peer = _PEERS[ctx.key]  # keeps the peer alive until backward


def _transpose(ctx, grad):
    return linear(grad, ctx.key, not ctx.back), None, None


def _mapped(info, in_dims, operand, key, back):
    moved = operand.movedim(in_dims[0], 0)
    return linear(moved.flatten(0, 1), key, back).unflatten(0, moved.shape[:2]), 0


linear.register_autograd(_transpose, setup_context=_keep)
linear.register_vmap(_mapped)
