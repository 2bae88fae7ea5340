"""What is made of a rig once on each device: a GPU's host waits for what is copied there."""

from collections import OrderedDict
from collections.abc import Callable, Hashable
from typing import Any
from weakref import WeakKeyDictionary

import torch
from torch import Tensor

from mvrecon.geometry.cameras.camera import Cameras, ExplicitRays
from mvrecon.geometry.grid import Grid

#: Results kept for a rig, the latest ones: more than a CUDA graph of it reads, which must stay.
KEPT = 256
_results: WeakKeyDictionary[Cameras, OrderedDict[Hashable, Any]] = WeakKeyDictionary()


def tensors_of(rays: Cameras | ExplicitRays) -> list[Tensor]:
    """The tensors that make rays."""
    return [value for value in vars(rays).values() if isinstance(value, Tensor)]


def writes(rays: Cameras | ExplicitRays) -> list[int]:
    """How often the rays' tensors were written to; those of inference mode do not count it."""
    return [tensor._version for tensor in tensors_of(rays) if not tensor.is_inference()]


def device_cached(cameras: Cameras, key: Hashable, like: Tensor, make: Callable[[], Any]) -> Any:
    """What `make` gives, made once as long as the rig lives and is not written to; in every call
    where its cameras want a gradient, or are traced.

    Args:
        cameras: the rig that the result is made of.
        key: what else it is made of.
        like: a tensor on the device for which it is made.
        make: makes it, on that device.
    """
    moving = any(tensor.requires_grad for tensor in tensors_of(cameras))
    if moving or torch.compiler.is_compiling():
        return make()
    results = _results.setdefault(cameras, OrderedDict())
    # of a tensor's type, too: numbers of a stand-in for a device are none of the device's
    whole = key, like.device, type(like), *writes(cameras)
    if whole in results:
        return results[whole]
    with torch.inference_mode(False):  # training may use what evaluation has made
        result = make()
    results[whole] = result
    while len(results) > KEPT:
        results.popitem(last=False)
    return result


def grid_key(grid: Grid) -> Hashable:
    """What tells a grid from others, for `device_cached`."""
    return grid.shape, tuple(grid.affine.flatten().tolist())
