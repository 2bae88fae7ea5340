"""Values derived from an operator, a rig or a tensor, each computed once and cached beside it.

A value is found by the identity of its object and by the state of everything that determines the
object's results: tensors by identity and version, on the CPU by their values too; numbers and names
by themselves. It is released with its object.
"""

from collections import OrderedDict
from collections.abc import Callable, Hashable, Iterable
from dataclasses import is_dataclass
from functools import partial
from hashlib import sha256
from types import FunctionType, MethodType, ModuleType
from typing import Any, TypeVar

import numpy as np
import torch
from torch import Tensor, nn
from torch.utils.weak import WeakIdKeyDictionary, WeakIdRef

from mvrecon.geometry.cameras.camera import Cameras, ExplicitRays
from mvrecon.geometry.grid import Grid
from mvrecon.operators.operator import Projector

Value = TypeVar("Value")

#: Latest values cached beside an object: more than a CUDA graph reads, as those must stay.
KEPT = 256
#: State and value by key, for each object.
_results: WeakIdKeyDictionary = WeakIdKeyDictionary()
#: Number of changes and latest values of each tensor on the CPU.
_values: WeakIdKeyDictionary = WeakIdKeyDictionary()
#: Attributes of modules, and of `FixedGeometry`, that do not affect results.
_BOOKKEEPING = {*vars(nn.Module()), "_written"} - {"_parameters", "_buffers", "_modules"}
_PLAIN = (str, bytes, int, float, type(None))


def kept(of: Any, key: Hashable, make: Callable[[], Value]) -> Value:
    """Return the result of `make`, cached beside an object until that is released or changes.

    Recomputed after the object, or anything in it, was replaced, moved or modified in place. On a
    GPU, writes through `.data` and to inference tensors are not detected, as this would
    synchronise. Computed in every call, with its graph, if a tensor of the object requires a
    gradient, and in graphs of `torch.compile`; a program of `torch.export` holds the latest value
    as a constant.

    Args:
        of: an operator, rig, grid or tensor. The value must not refer to it, else neither would be
            freed.
        key: of the value among those of the object, with all else that determines it.
        make: computes the value.
    """
    if torch.compiler.is_compiling():
        known = _results.get(of, {}).get(key) if torch.compiler.is_exporting() else None
        return make() if known is None else known[1]
    parts = determinants(of)
    if any(isinstance(part, Tensor) and part.requires_grad for part in parts):
        return make()
    results = _results.setdefault(of, OrderedDict())
    known = results.get(key)
    if known is None or known[0] != _state(parts):
        with torch.inference_mode(False), torch.no_grad():  # training may use it after evaluation
            value = make()
        # the state after it, as operators may compute attributes when first used
        known = results[key] = _state(determinants(of)), value
        while len(results) > KEPT:
            results.popitem(last=False)
    return known[1]


def contents(*things: Any) -> Hashable:
    """A key of everything that determines the results of objects, by value: equal for equal
    operators, however they were built. Synchronises with a GPU for tensors not seen before.
    """
    parts = determinants(things)
    return tuple(
        kept(part, "digest", partial(digest, part)) if isinstance(part, Tensor) else part
        for part in parts
    )


def digest(tensor: Tensor) -> Hashable:
    """Type, shape and SHA-256 of a tensor's values; synchronises with a GPU."""
    values = tensor.detach().to_dense().cpu().contiguous().flatten().view(torch.uint8)
    return tensor.dtype, tensor.shape, sha256(values.numpy().tobytes()).digest()


def determinants(thing: Any) -> list[Any]:
    """The tensors, numbers and names that determine the results of an object, in a fixed order.

    They are those of its attributes and of their attributes, except attributes that begin with
    `last`, which report on the latest call. An object without attributes counts by its identity.
    """
    found: list[Any] = []
    _collect(thing, found, {})
    return found


def _collect(thing: Any, found: list[Any], visited: dict[int, tuple[int, Any]]) -> None:
    """Append the determinants of an object, or its number if it has been visited."""
    if isinstance(thing, (Tensor, *_PLAIN)):
        found.append(thing)
    elif id(thing) in visited:
        found.append(visited[id(thing)][0])
    elif (parts := _parts(thing)) is None:
        found.append(_identity(thing))
    else:
        if not isinstance(thing, tuple):
            visited[id(thing)] = len(visited), thing  # alive, so that its id is not reused
        parts = list(parts)
        found += [type(thing), len(parts)]  # else [[1], 2] would be as [[1, 2]]
        for part in parts:
            _collect(part, found, visited)


def _parts(thing: Any) -> Iterable[Any] | None:
    """The parts of an object; None for one without any."""
    if isinstance(thing, dict):
        return [each for pair in thing.items() for each in pair]
    if isinstance(thing, list | tuple):
        return thing
    if isinstance(thing, set | frozenset):
        return sorted(map(repr, thing))
    if isinstance(thing, np.ndarray):
        return thing.dtype.str, thing.shape, sha256(thing.tobytes()).digest()
    if isinstance(thing, partial):
        return thing.func, thing.args, thing.keywords
    if isinstance(thing, MethodType):
        return thing.__func__, thing.__self__
    if isinstance(thing, FunctionType):
        cells = [cell.cell_contents for cell in thing.__closure__ or ()]
        return thing.__code__, thing.__defaults__, thing.__kwdefaults__, cells
    if isinstance(thing, type | ModuleType) or not hasattr(thing, "__dict__"):
        return None
    if is_dataclass(thing):  # without cached properties
        return [getattr(thing, name) for name in thing.__dataclass_fields__]
    named = ((name, value) for name, value in vars(thing).items() if name not in _BOOKKEEPING)
    return [each for pair in named if not pair[0].lstrip("_").startswith("last") for each in pair]


def _identity(thing: Any) -> Hashable:
    try:
        return WeakIdRef(thing)
    except TypeError:  # values of Python, NumPy and torch that have no attributes
        return repr(thing)


def _state(parts: list[Any]) -> list[Any]:
    return [
        (WeakIdRef(part), *version(part)) if isinstance(part, Tensor) else part for part in parts
    ]


def version(tensor: Tensor) -> tuple[int, int]:
    """Numbers that change with a tensor's values, without synchronisation.

    On the CPU the values are compared with a copy of the latest, as torch does not count changes
    through NumPy, `.data` and in inference mode; on a GPU torch's count and the address decide.
    """
    written = 0 if tensor.is_inference() else tensor._version
    try:
        address = tensor.untyped_storage().data_ptr()
    except NotImplementedError:  # sparse, or of `torch.func`
        return written, 0
    if not tensor.is_cpu:
        return written, address
    number, values = _values.get(tensor, (0, None))
    if values is None or values.dtype != tensor.dtype or not torch.equal(values, tensor):
        number += 1
        _values[tensor] = number, tensor.detach().clone()
    return number, 0


class FixedGeometry(Projector):
    """A projector that is computed once from a grid and rays, which then must not change."""

    def built_from(self, grid: Grid, rays: Cameras | ExplicitRays) -> None:
        """Set the grid and the rays, and remember their state."""
        self._geometry = grid, rays
        self._written = writes(grid, rays)

    @property
    def grid(self) -> Grid:
        """The voxels."""
        return self._geometry[0]

    @property
    def rays(self) -> Cameras | ExplicitRays:
        """The rig, or explicit rays."""
        return self._geometry[1]

    @property
    def cameras(self) -> Cameras:
        """The rig.

        Raises:
            ValueError: the operator was built from explicit rays.
        """
        if isinstance(self.rays, ExplicitRays):
            raise ValueError("Expected a projector with cameras, got one of explicit rays")
        return self.rays

    @property
    def pose_gradient(self) -> bool:
        """Whether the cameras require a gradient; the rays are then recomputed in every call."""
        return any(tensor.requires_grad for tensor in tensors_of(self.rays))

    def check_unchanged(self) -> None:
        """Raise if grid or rays without a gradient changed in place; not detected in traced
        programs.

        Raises:
            RuntimeError: they were changed after the projector was built.
        """
        if torch.compiler.is_compiling():
            return
        if writes(*self._geometry) != self._written and not self.pose_gradient:
            raise RuntimeError(
                "The tensors of the cameras or of the grid were changed in place after the "
                "projector was built; build another one, or let the cameras require a gradient "
                "before"
            )

    def __reduce_ex__(self, protocol: Any) -> Any:
        """Copy or pickle; raises as `check_unchanged`."""
        self.check_unchanged()
        return super().__reduce_ex__(protocol)

    def __setstate__(self, state: Any) -> None:
        super().__setstate__(state)
        self._written = writes(*self._geometry)  # version counters of copies start at zero


def tensors_of(*records: Grid | Cameras | ExplicitRays) -> list[Tensor]:
    """The tensors that define grids and rays."""
    # torch 2.11's compile does not trace vars()
    values = (getattr(one, name) for one in records for name in one.__dataclass_fields__)
    return [value for value in values if isinstance(value, Tensor)]


def writes(*records: Grid | Cameras | ExplicitRays) -> list[int]:
    """Version counters of the tensors; those of inference mode have none."""
    return [tensor._version for tensor in tensors_of(*records) if not tensor.is_inference()]


def place(like: Tensor) -> Hashable:
    """The device of a tensor as a part of a key."""
    return like.device, type(like)  # a stand-in device has values of its own


def grid_key(grid: Grid) -> Hashable:
    """A grid's voxels and their positions as a part of a key."""
    return grid.shape, tuple(grid.affine.flatten().tolist())
