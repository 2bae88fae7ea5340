"""Values derived from an operator, a rig or a tensor, each computed once and cached beside it.

A value is found by the identity of its object and by the state of everything that determines the
object's results: tensors by identity and version, on the CPU by their values too; numbers and names
by themselves. It is released with its object.
"""

from array import array
from collections import OrderedDict, deque
from collections.abc import Callable, Hashable, Iterator, Sequence
from contextlib import contextmanager
from functools import cached_property, partial
from hashlib import sha256
from itertools import count
from types import CellType, CodeType, FunctionType, MappingProxyType, MethodType, ModuleType
from typing import Any, TypeVar, cast
from weakref import ref

import numpy as np
import torch
from torch import Tensor, nn
from torch.utils.weak import WeakIdKeyDictionary, WeakIdRef

from mvrecon.geometry.cameras.camera import Cameras, ExplicitRays
from mvrecon.geometry.grid import Grid
from mvrecon.operators.operator import Projector

Value = TypeVar("Value")

#: Latest values cached beside an object: more than a CUDA graph reads, as those must stay.
MAX_RESULTS = 256
#: State and value by key, for each object.
_results: WeakIdKeyDictionary = WeakIdKeyDictionary()
#: Number of the latest change and the values after it, of each tensor on the CPU.
_values: WeakIdKeyDictionary = WeakIdKeyDictionary()
#: Numbers of changes: no two are equal, also in threads.
_changes = count(1)
#: Attributes of modules that affect results; their others, and those of `FixedGeometry`, do not.
_OF_MODULES = {"_parameters", "_buffers", "_modules", "_forward_hooks", "_forward_pre_hooks"}
_BOOKKEEPING = {*vars(nn.Module()), "_written", "_copies"} - _OF_MODULES
#: Global variables that count.
_DATA = Tensor, np.ndarray, int, float
_NAMES = str, bytes, type(None), type, ModuleType, CodeType


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
        key: what distinguishes the value among those of the object, with all else that determines
            it.
        make: function that computes the value.
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
        with _independently():
            value = make()
        # the state after it, as operators may compute attributes when first used
        known = results[key] = _state(determinants(of)), value
        while len(results) > MAX_RESULTS:
            results.popitem(last=False)
    return known[1]


@contextmanager
def _independently() -> Iterator[None]:
    """Context whose results do not depend on the caller's: training may use those of evaluation,
    and float32 those of half precision.
    """
    plain = torch.autocast("cpu", enabled=False), torch.autocast("cuda", enabled=False)
    with torch.inference_mode(False), torch.no_grad(), plain[0], plain[1]:
        yield


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
    stored = [one.cpu().contiguous().flatten().view(torch.uint8) for one in _stored(tensor)]
    return tensor.dtype, tensor.shape, *(sha256(one.numpy().tobytes()).digest() for one in stored)


def _stored(tensor: Tensor) -> list[Tensor]:
    """The strided tensors that hold a tensor's values, without a graph."""
    tensor = tensor.detach()
    if tensor.layout == torch.strided:
        return [tensor.resolve_conj().resolve_neg()]
    if tensor.layout == torch.sparse_coo:
        return [tensor._indices(), tensor._values()]
    if tensor.layout in (torch.sparse_csr, torch.sparse_bsr):
        return [tensor.crow_indices(), tensor.col_indices(), tensor.values()]
    if tensor.layout in (torch.sparse_csc, torch.sparse_bsc):
        return [tensor.ccol_indices(), tensor.row_indices(), tensor.values()]
    return [tensor.to_dense()]


def determinants(thing: Any) -> list[Any]:
    """The tensors, numbers and names that determine the results of an object, in a fixed order.

    They are those of its attributes and of their attributes, of closures, and of global tensors,
    arrays and numbers that a function among them names; not of the functions that it calls, nor of
    classes. Attributes `last` and `last_...`, which report on the latest call, and cached
    properties do not count. An object without attributes counts by its identity.
    """
    found: list[Any] = []
    _collect(thing, found, {})
    return found


def _collect(thing: Any, found: list[Any], visited: dict[int, tuple[int, Any]]) -> None:
    """Append the determinants of an object, or its number if it has been visited."""
    if isinstance(thing, (Tensor, *_NAMES)):
        found.append(thing)
    elif isinstance(thing, int | float):
        found += [type(thing), repr(thing)]  # True is not 1, and NaN is NaN
    elif id(thing) in visited:
        found += [_collect, visited[id(thing)][0]]
    elif (parts := _parts(thing)) is None:
        found.append(_identity(thing))
    else:
        if not isinstance(thing, tuple):
            visited[id(thing)] = len(visited), thing  # alive, so that its id is not reused
        found += [type(thing), len(parts)]  # else [[1], 2] would be as [[1, 2]]
        for part in parts:
            _collect(part, found, visited)


def _parts(thing: Any) -> Sequence[Any] | None:
    """The content and the attributes of an object; None for one without either."""
    content, state = _content(thing), cast(Any, object.__getstate__(thing))
    if content is None and state is None:
        return None
    own, slots = state if isinstance(state, tuple) else (state, None)
    attributes: dict[str, Any] = {**(own or {}), **(slots or {})}
    named = [
        value
        for pair in attributes.items()
        if pair[0] not in _BOOKKEEPING and not _follows(type(thing), pair[0])
        for value in pair
    ]
    return [*(content or ()), *named]


def _follows(kind: type, name: str) -> bool:
    """Whether an attribute follows from the others: a report of the latest call, or cached."""
    reports = name.lstrip("_").partition("_")[0] == "last"
    return reports or isinstance(getattr(kind, name, None), cached_property)


def _content(thing: Any) -> Sequence[Any] | None:
    """The content of containers, arrays and functions; None for other objects."""
    if isinstance(thing, dict | MappingProxyType):
        return [each for pair in thing.items() for each in pair]
    if isinstance(thing, list | tuple | deque | array):
        return thing
    if isinstance(thing, set | frozenset):
        return sorted(thing, key=repr)
    if isinstance(thing, np.ndarray):
        values = thing.tolist() if thing.dtype.hasobject else sha256(thing.tobytes()).digest()
        return repr(thing.dtype), thing.shape, values
    if isinstance(thing, partial):
        return thing.func, thing.args, thing.keywords
    if isinstance(thing, MethodType):
        return thing.__func__, thing.__self__
    if isinstance(thing, FunctionType):
        code, scope = thing.__code__, thing.__globals__
        named = [scope[name] for name in _names(code) if isinstance(scope.get(name), _DATA)]
        cells = list(thing.__closure__ or ())
        return code, thing.__defaults__, thing.__kwdefaults__, cells, named
    if isinstance(thing, torch.jit.ScriptModule):
        return [*thing.parameters(), *thing.buffers()]
    if isinstance(thing, CellType):
        return [] if thing == CellType() else [thing.cell_contents]
    if isinstance(thing, ref):
        return [thing()]
    if (bound := getattr(thing, "__self__", None)) is not None:  # a method in C
        return thing.__name__, bound
    return None


def _names(code: CodeType) -> list[str]:
    """Names of global variables in a function and in those within it, comprehensions too."""
    inner = [name for part in code.co_consts if isinstance(part, CodeType) for name in _names(part)]
    return [*code.co_names, *inner]


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
    written, address = 0 if tensor.is_inference() else tensor._version, 0
    if tensor.layout == torch.strided:
        try:
            address = tensor.untyped_storage().data_ptr()
        except NotImplementedError:  # of `torch.func`
            return written, 0
    if not tensor.is_cpu:
        return written, address
    stored = _stored(tensor)
    number, values = _values.get(tensor, (0, ()))
    if len(values) != len(stored) or not all(map(_same, values, stored)):
        number = next(_changes)
        _values[tensor] = number, [one.clone() for one in stored]
    return number, 0


def _same(one: Tensor, other: Tensor) -> bool:
    """Whether tensors have equal types and values, NaN at the same places included."""
    if one.dtype != other.dtype or one.shape != other.shape:
        return False
    if torch.equal(one, other):
        return True
    nan = (one != one) & (other != other)
    return bool(((one == other) | nan).all())


class FixedGeometry(Projector):
    """A projector that is computed once from a grid and rays, which then must not change."""

    #: Whether rays with a gradient may change, as they are recomputed in every call.
    follows_gradient = True

    def built_from(self, grid: Grid, rays: Cameras | ExplicitRays) -> None:
        """Set the grid and the rays, and remember their state."""
        self._geometry = grid, rays
        self._remember()

    def _remember(self) -> None:
        tensors = tensors_of(*self._geometry)
        self._written = [version(tensor) for tensor in tensors]
        #: their values where `version` has compared them; equal ones save its time in every call
        self._copies = [one for tensor in tensors for one in _values.get(tensor, (0, ()))[1]]

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
        """Raise if grid or rays changed in place, except those with a gradient if the projector
        follows them; not detected in traced programs.

        Raises:
            RuntimeError: they were changed after the projector was built.
        """
        if torch.compiler.is_compiling():
            return
        tensors = tensors_of(*self._geometry)
        if len(self._copies) == len(tensors) and all(map(torch.equal, tensors, self._copies)):
            return
        changed = [version(tensor) for tensor in tensors] != self._written
        if changed and not (self.follows_gradient and self.pose_gradient):
            cure = ", or let the cameras require a gradient before" if self.follows_gradient else ""
            raise RuntimeError(
                f"The tensors of the cameras or of the grid were changed in place after the "
                f"projector was built; build another one{cure}"
            )

    def __reduce_ex__(self, protocol: Any) -> Any:
        """Copy or pickle; raises as `check_unchanged`."""
        self.check_unchanged()
        return super().__reduce_ex__(protocol)

    def __setstate__(self, state: Any) -> None:
        super().__setstate__(state)
        self._remember()  # version counters of copies start at zero


def tensors_of(*records: Grid | Cameras | ExplicitRays) -> list[Tensor]:
    """The tensors that define grids and rays."""
    # torch 2.11's compile does not trace vars()
    values = (getattr(one, name) for one in records for name in one.__dataclass_fields__)
    return [value for value in values if isinstance(value, Tensor)]


def place(like: Tensor) -> Hashable:
    """The device of a tensor as a part of a key."""
    return like.device, type(like)  # a stand-in device has values of its own


def grid_key(grid: Grid) -> Hashable:
    """A grid's voxels and their positions as a part of a key."""
    return grid.shape, tuple(grid.affine.flatten().tolist())
