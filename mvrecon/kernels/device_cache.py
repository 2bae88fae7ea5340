"""Cache of quantities derived from a rig on each device, as copies to a GPU synchronise."""

from collections import OrderedDict
from collections.abc import Callable, Hashable
from typing import Any
from weakref import WeakKeyDictionary

import torch
from torch import Tensor

from mvrecon.geometry.cameras.camera import Cameras, ExplicitRays
from mvrecon.geometry.grid import Grid

#: Latest results cached for a rig: more than a CUDA graph of it reads, as those must stay.
KEPT = 256
_results: WeakKeyDictionary[Cameras, OrderedDict[Hashable, Any]] = WeakKeyDictionary()


def tensors_of(rays: Cameras | ExplicitRays) -> list[Tensor]:
    """The tensors that define rays."""
    # torch 2.11's compile does not trace vars()
    values = (getattr(rays, name) for name in rays.__dataclass_fields__)
    return [value for value in values if isinstance(value, Tensor)]


def writes(rays: Cameras | ExplicitRays) -> list[int]:
    """Version counters of the rays' tensors; those of inference mode have none."""
    return [tensor._version for tensor in tensors_of(rays) if not tensor.is_inference()]


def device_cached(cameras: Cameras, key: Hashable, like: Tensor, make: Callable[[], Any]) -> Any:
    """Return the result of `make`, cached until the rig is freed or modified; recomputed in every
    call if its cameras require a gradient or are traced.

    Args:
        cameras: the rig from which the result is computed.
        key: of all other inputs.
        like: a tensor on the target device.
        make: computes the result on that device.
    """
    moving = any(tensor.requires_grad for tensor in tensors_of(cameras))
    if moving or torch.compiler.is_compiling():
        return make()
    results = _results.setdefault(cameras, OrderedDict())
    # the type: a stand-in device has results of its own
    whole = key, like.device, type(like), *writes(cameras)
    if whole in results:
        return results[whole]
    with torch.inference_mode(False):  # training may use results of evaluation
        result = make()
    results[whole] = result
    while len(results) > KEPT:
        results.popitem(last=False)
    return result


def grid_key(grid: Grid) -> Hashable:
    """A hashable identity of a grid, for `device_cached`."""
    return grid.shape, tuple(grid.affine.flatten().tolist())
