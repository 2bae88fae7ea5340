"""Tensors that say that they lie on a GPU and keep their numbers in main memory: no GPU is needed.

What runs on them shows, with real values and so with the real flow of control: devices that do not
meet (an error, as on a GPU), where the host waits for the device (`waits`, by place in mvrecon),
and how many kernels are started (`launches`; what an opaque operator starts inside counts as one).
Forward only.
"""

import traceback
from collections import Counter
from typing import Any

import torch
from torch.overrides import TorchFunctionMode
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves, tree_map

# before anything is on a device that is not there
torch._C._ensureCUDADeviceGuardSet()  # pyright: ignore[reportAttributeAccessIssue]
torch.cuda._lazy_init = lambda: None
GPU = torch.device("cuda", 0)
waits: Counter = Counter()
launches: Counter = Counter()
COPIED = "copied from main memory, which waits"
#: Operators that take tensors of both memories.
MIXED = {
    *("index", "index_put", "_index_put_impl", "index_put_", "_unsafe_index_put", "_unsafe_index"),
    *("project", "backproject", "lines_vjp", "copy_", "_to_copy"),
}
#: Operators whose result, or its size, the host waits for.
WAITING = {
    *("_local_scalar_dense", "nonzero", "unique_dim", "_unique2", "equal"),
    *("masked_select", "unique_consecutive"),
}
FACTORIES = {
    *("tensor", "as_tensor", "arange", "linspace", "zeros", "ones", "full", "empty", "eye"),
    *("rand", "randn", "zeros_like", "ones_like", "full_like", "empty_like"),
}


def place() -> str:
    """The innermost line of mvrecon that is at work."""
    frames = [f for f in traceback.extract_stack() if "/mvrecon/" in f.filename]
    return f"{frames[-1].filename.split('/mvrecon/')[-1]}:{frames[-1].lineno}" if frames else "-"


def wait(why: str, times: int = 1) -> None:
    """Count a wait of the host."""
    waits[place(), why] += times


def is_gpu(device: Any) -> bool:
    """Whether a device is named that is a GPU."""
    return device is not None and torch.device(device).type == "cuda"


class OnGpu(torch.Tensor):
    """A tensor in main memory that says it is on a GPU."""

    __torch_function__ = torch._C._disabled_torch_function_impl
    values: torch.Tensor

    @staticmethod
    def __new__(cls, values: torch.Tensor):
        layout = {"strides": values.stride(), "storage_offset": values.storage_offset()}
        tensor = torch.Tensor._make_wrapper_subclass(  # pyright: ignore[reportAttributeAccessIssue]
            cls,
            values.shape,
            **layout,
            dtype=values.dtype,
            device=torch.device("meta"),
            dispatch_device=True,
        )
        tensor.values = values
        return tensor

    def __init__(self, values: torch.Tensor):
        super().__init__()

    def __repr__(self, **_: Any) -> str:
        return f"OnGpu({tuple(self.shape)})"

    @classmethod
    def __torch_dispatch__(cls, func, types, args=(), kwargs=None):
        return dispatch(func, args, kwargs or {})


def values_of(x: Any) -> Any:
    """The numbers of a tensor in main memory."""
    return x.values if isinstance(x, OnGpu) else x


def on_gpu(x: Any) -> Any:
    """A tensor as if on a GPU."""
    return OnGpu(x) if isinstance(x, torch.Tensor) and not isinstance(x, OnGpu) else x


def dispatch(func: Any, args: tuple, kwargs: dict[str, Any]) -> Any:
    """Run an operator in main memory, and count what it would cost."""
    space, _, name = str(func.overloadpacket).partition(".")
    if name == "device" and space == "prim":
        return GPU if isinstance(args[0], OnGpu) else args[0].device
    tensors = [x for x in tree_leaves((args, kwargs)) if isinstance(x, torch.Tensor)]
    device = any(isinstance(x, OnGpu) for x in tensors)
    host = [tuple(x.shape) for x in tensors if not isinstance(x, OnGpu) and x.ndim]
    if device and host and name not in MIXED:
        raise RuntimeError(f"{space}.{name}: tensors on cuda:0 and in main memory, {host}")
    wanted = kwargs.get("device")
    plain, options = tree_map(values_of, (args, kwargs))
    if is_gpu(wanted):
        options = {**options, "device": torch.device("cpu")}
    if device:
        count_waits(name, args)
    if name == "_to_copy" and wanted is not None and device != is_gpu(wanted):
        wait("copy to main memory" if device else f"a tensor {COPIED}")
    result = func(*plain, **options)
    if (space, name) == ("mvrecon", "occupied"):
        wait("occupied: three nonzero().tolist()", 3)
        return result
    stays = is_gpu(wanted) if wanted is not None else device
    if name in ("_local_scalar_dense", "equal") or not stays:
        return result
    launches[name] += 1
    in_place = name.endswith("_") and not name.endswith("__")
    return args[0] if in_place and isinstance(args[0], OnGpu) else tree_map(on_gpu, result)


def count_waits(name: str, args: tuple) -> None:
    """The waits of an operator on a tensor of the device."""
    if name in WAITING:
        wait(name)
    indices = args[1] if name.startswith("index") and len(args) > 1 else ()
    if isinstance(indices, list | tuple):
        tensors = [i for i in indices if isinstance(i, torch.Tensor)]
        if any(i.dtype == torch.bool for i in tensors):
            wait("an index that is a mask")
        if any(not isinstance(i, OnGpu) for i in tensors):
            wait(f"an index {COPIED}")


class Memory(TorchDispatchMode):
    """Operators."""

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        return dispatch(func, args, kwargs or {})


class Calls(TorchFunctionMode):
    """Factories on the device, and what a tensor of this kind cannot be asked."""

    def __torch_function__(self, func, types, args=(), kwargs=None):
        kwargs, name = kwargs or {}, getattr(func, "__name__", "")
        if args and isinstance(args[0], OnGpu):
            method = getattr(self, f"_{name.strip('_')}", None)
            return method(func, *args, **kwargs) if method else func(*args, **kwargs)
        if is_gpu(kwargs.get("device")) and name in FACTORIES:
            source = args[0] if args else None
            if name in ("tensor", "as_tensor") and not isinstance(source, torch.Tensor):
                wait(f"torch.{name}, {COPIED}")
            launches[name] += 1
            return on_gpu(func(*map(values_of, args), **{**kwargs, "device": "cpu"}))
        return func(*args, **kwargs)

    def _tolist(self, func, tensor):
        wait("tolist")
        return tensor.values.tolist()

    def _numpy(self, func, tensor):
        wait("numpy")
        return tensor.values.numpy()

    def _new_tensor(self, func, tensor, data, dtype=None, **_):
        wait(f"new_tensor, {COPIED}")
        return OnGpu(torch.tensor(data, dtype=dtype or tensor.dtype))

    def _unravel_index(self, func, tensor, shape):
        wait(f"unravel_index, {COPIED}")
        launches["unravel_index"] += 6
        return tuple(map(OnGpu, torch.unravel_index(tensor.values, shape)))

    def _getitem(self, func, tensor, index, *value):
        many = isinstance(index, tuple)
        moved = tuple(map(self._moved, index if many else (index,)))
        return func(tensor, moved if many else moved[0], *value)

    _setitem = _getitem

    @staticmethod
    def _moved(index: Any) -> Any:
        if isinstance(index, list):
            wait(f"an index of a list, {COPIED}")
            return OnGpu(torch.tensor(index))
        if isinstance(index, torch.Tensor) and not isinstance(index, OnGpu) and index.ndim:
            wait(f"an index {COPIED}")
            return OnGpu(index)
        return index


class AsGpu:
    """Inside, tensors made on "cuda" are `OnGpu`, and the counts begin at zero."""

    def __enter__(self) -> "AsGpu":
        waits.clear()
        launches.clear()
        self.modes = Memory(), Calls()
        for mode in self.modes:
            mode.__enter__()
        return self

    def __exit__(self, *error: Any) -> None:
        for mode in reversed(self.modes):
            mode.__exit__(*error)


def put(module: torch.nn.Module) -> torch.nn.Module:
    """A module with its weights and buffers as if on a GPU."""
    for part in module.modules():
        for name, value in list(part._parameters.items()):
            if value is not None:
                part._parameters[name] = torch.nn.Parameter(OnGpu(value.data), requires_grad=False)
        for name, value in list(part._buffers.items()):
            if value is not None:
                part._buffers[name] = OnGpu(value)
    return module
