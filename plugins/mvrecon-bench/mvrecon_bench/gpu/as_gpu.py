"""An emulated GPU that counts synchronisations: tensors that report a GPU as their device, with
their values in main memory. It requires neither a GPU nor a CUDA build of torch.

    with AsGpu() as gpu:
        loss = model(on_gpu(views)).volume.sum()
        loss.backward()
    assert not gpu.waits

Values, control flow and derivatives are real. Mixing tensors of both devices raises an error, as on
a GPU. Random numbers are those of the CPU. Convention: C++ sees these tensors on torch's "meta"
device, Python on "cuda:0".
"""

import traceback
from collections import Counter
from collections.abc import Callable, Iterator
from typing import Any

import torch
from torch import Tensor, nn
from torch.overrides import TorchFunctionMode
from torch.utils._python_dispatch import TorchDispatchMode

from mvrecon.kernels import self_test

GPU = torch.device("cuda", 0)
#: Operators that accept tensors on different devices.
MIXED = {"copy_", "_to_copy", "index", "index_put", "index_put_", "_index_put_impl_"}
#: Operators of mvrecon that read integers (the position of a support) from main memory.
ALONG_RAYS = {"project", "backproject", "lines_vjp"}
#: Operators for whose result or its size the host synchronises.
WAITING = {
    *("_local_scalar_dense", "nonzero", "masked_select", "equal", "is_nonzero", "bincount"),
    *("_unique", "_unique2", "unique_dim", "unique_consecutive", "histc"),
}
#: Functions of torch that synchronise to check whether a matrix is regular or an iteration has
#: converged.
CHECKED = {f"linalg_{name}" for name in ("inv", "solve", "cholesky", "eigh", "eigvalsh", "svd")}
CHECKED |= {"inverse", "linalg_pinv", "linalg_svdvals"}
#: Products, which a GPU supports only for floating-point numbers.
PRODUCTS = {"mm", "mv", "bmm", "dot", "addmm", "addmv", "baddbmm"}
#: Operators that launch no kernel.
NOTHING = {"empty", "empty_like", "empty_strided", "new_empty", "new_empty_strided", "detach"}
COPIED = "copied from main memory"
#: Part of a file's path with which the name of a source position begins.
PACKAGE = "mvrecon"


class OnGpu(Tensor):
    """A tensor in main memory that reports a GPU as its device."""

    __torch_function__ = torch._C._disabled_torch_function_impl
    values: Tensor
    device = property(lambda self: GPU)  # pyrefly: ignore[bad-assignment]
    is_cuda = property(lambda self: True)  # pyrefly: ignore[bad-assignment]
    is_cpu = property(lambda self: False)  # pyrefly: ignore[bad-assignment]
    is_meta = property(lambda self: False)  # pyrefly: ignore[bad-assignment]

    @staticmethod
    def __new__(cls, values: Tensor) -> "OnGpu":
        layout = {"strides": values.stride(), "storage_offset": values.storage_offset()}
        tensor = Tensor._make_wrapper_subclass(
            cls, values.shape, **layout, dtype=values.dtype, device=torch.device("meta")
        )
        tensor.values = values
        return tensor

    def __init__(self, values: Tensor):
        super().__init__()

    def __repr__(self, **_: Any) -> str:
        return f"OnGpu({tuple(self.shape)})"

    @classmethod
    def __torch_dispatch__(cls, func, types, args=(), kwargs=None):
        raise RuntimeError(f"{func} of a tensor of the stand-in for a GPU, outside of AsGpu")


def on_gpu(x: Any) -> Any:
    """Emulate a tensor on a GPU; return anything else unchanged."""
    return OnGpu(x) if isinstance(x, Tensor) and not isinstance(x, OnGpu) else x


def leaves(x: Any) -> Iterator[Any]:
    """The values in nested tuples, lists and dicts; faster than torch's pytree."""
    if isinstance(x, tuple | list | dict):
        for value in x.values() if isinstance(x, dict) else x:
            yield from leaves(value)
    else:
        yield x


def mapped(change: Callable[[Any], Any], x: Any) -> Any:
    """Apply a function to the values in nested tuples, lists and dicts."""
    if isinstance(x, tuple | list):
        return type(x)([mapped(change, value) for value in x])
    if isinstance(x, dict):
        return {key: mapped(change, value) for key, value in x.items()}
    return change(x)


def in_memory(x: Any) -> Any:
    """Return the values of a tensor in main memory; anything else unchanged."""
    return x.values if isinstance(x, OnGpu) else x


class AsGpu:
    """Context in which tensors created on "cuda" are `OnGpu`, the CUDA back end counts as verified,
    and synchronisations and launches are counted.

    An opaque operator of mvrecon counts as one launch.
    """

    def __init__(self) -> None:
        self.waits: Counter[tuple[str, str]] = Counter()
        self.launches: Counter[str] = Counter()

    def __enter__(self) -> "AsGpu":
        self._before = torch.cuda._lazy_init, self_test.failure
        torch.cuda._lazy_init = lambda: None
        self_test.failure = lambda *_: None  # pyrefly: ignore[bad-assignment]
        self._modes = _Operators(self), _Calls(self)
        for mode in self._modes:
            mode.__enter__()
        return self

    def __exit__(self, *error: Any) -> None:
        for mode in reversed(self._modes):
            mode.__exit__(*error)
        torch.cuda._lazy_init, self_test.failure = self._before

    def put(self, module: nn.Module) -> nn.Module:
        """Emulate moving a module to the GPU, and reset the counts."""
        module._apply(on_gpu)
        if hasattr(module, "_device"):  # a LightningModule
            module._device = GPU  # pyrefly: ignore[bad-argument-type]
        self.waits.clear()
        self.launches.clear()
        return module

    def wait(self, why: str) -> None:
        """Count a synchronisation at the innermost active line of mvrecon."""
        lines = [f for f in traceback.extract_stack() if f"/{PACKAGE}/" in f.filename]
        inner = [f for f in lines if f.filename != __file__]
        place = "-"
        if inner:
            place = f"{inner[-1].filename.rpartition(f'/{PACKAGE}/')[2]}:{inner[-1].lineno}"
        self.waits[place, why] += 1


class _Operators(TorchDispatchMode):
    """Runs operators in main memory and counts their synchronisations and launches."""

    def __init__(self, gpu: AsGpu):
        super().__init__()
        self.gpu = gpu

    def __torch_dispatch__(self, func, types, args: tuple = (), kwargs=None):
        kwargs, name = kwargs or {}, str(func.overloadpacket).partition(".")[2]
        tensors = [x for x in leaves((args, kwargs)) if isinstance(x, Tensor)]
        device = any(isinstance(x, OnGpu) for x in tensors)
        read = name in ALONG_RAYS
        away = [x for x in tensors if not isinstance(x, OnGpu) and x.ndim]
        host = [tuple(x.shape) for x in away if not (read and x.dtype == torch.int32)]
        if device and host and name not in MIXED:
            raise RuntimeError(f"{func}: tensors on cuda:0 and in main memory, {host}")
        if device and name in PRODUCTS and not tensors[0].is_floating_point():
            raise RuntimeError(f"{func}: a GPU has none of {tensors[0].dtype}")
        if device:
            self._count_waits(name, args)
        wanted = kwargs.get("device")
        if name == "_to_copy" and wanted is not None and device != _is_gpu(wanted):
            self.gpu.wait("copied to main memory" if device else COPIED)
        plain, options = mapped(in_memory, (args, kwargs))
        if _is_gpu(wanted):
            options = {**options, "device": torch.device("cpu")}
        result = func(*plain, **options)
        stays = _is_gpu(wanted) if wanted is not None else device
        if result is None or name == "_local_scalar_dense" or not stays:
            return result
        if name not in NOTHING and not func.is_view:
            self.gpu.launches[name] += 1
        if name.endswith("_") and not name.endswith("__"):
            return args[0]
        return mapped(on_gpu, result)

    def _count_waits(self, name: str, args: tuple) -> None:
        if name in WAITING:
            self.gpu.wait(name)
        if name == "copy_" and isinstance(args[0], OnGpu) != isinstance(args[1], OnGpu):
            self.gpu.wait("copied between the memories")
        if name == "repeat_interleave":  # for a tensor of repeats
            self.gpu.wait(name)
        indices = args[1] if name.startswith(("index", "_index")) and len(args) > 1 else ()
        tensors = [i for i in leaves(indices) if isinstance(i, Tensor)]
        # assigning a scalar through a mask is a fill
        if any(i.dtype == torch.bool for i in tensors) and "put" not in name:
            self.gpu.wait("an index that is a mask")
        if name != "index_select" and any(not isinstance(i, OnGpu) for i in tensors):
            self.gpu.wait(f"an index {COPIED}")


class _Calls(TorchFunctionMode):
    """Handles functions that emulated tensors do not support or that dispatch to no operator."""

    def __init__(self, gpu: AsGpu):
        super().__init__()
        self.gpu = gpu

    def __torch_function__(self, func, types, args: tuple = (), kwargs=None):
        kwargs, name = kwargs or {}, getattr(func, "__name__", "").strip("_")
        if args and isinstance(args[0], OnGpu) and name in self.ANSWERS:
            return self.ANSWERS[name](self, func, *args, **kwargs)
        if name in CHECKED and any(isinstance(x, OnGpu) for x in leaves((args, kwargs))):
            self.gpu.wait(name)
        if name == "to":
            args, kwargs = mapped(_numbered, (args, kwargs))
        if name in ("tensor", "as_tensor") and _is_gpu(kwargs.get("device")):
            source, dtype = args[0], kwargs.get("dtype")
            if not isinstance(source, OnGpu):
                self.gpu.wait(f"torch.{name}, {COPIED}")
            return OnGpu(func(in_memory(source), dtype=dtype))
        return func(*args, **kwargs)

    def _tolist(self, func: Any, tensor: OnGpu) -> Any:
        self.gpu.wait("tolist")
        return tensor.values.tolist()

    def _numpy(self, func: Any, tensor: OnGpu, **_: Any) -> Any:
        raise TypeError("can't convert cuda:0 device type tensor to numpy")

    def _new_tensor(self, func: Any, tensor: OnGpu, data: Any, dtype: Any = None, **_: Any) -> Any:
        self.gpu.wait(f"new_tensor, {COPIED}")
        return OnGpu(torch.tensor(data, dtype=dtype or tensor.dtype))

    def _to(self, func: Any, tensor: OnGpu, *args: Any, **kwargs: Any) -> Any:
        """C++ would copy tensors that are already on the device."""
        device, dtype, _, layout = torch._C._nn._parse_to(
            *args, **{k: v for k, v in kwargs.items() if k != "copy"}
        )
        copy = kwargs.get("copy", False)
        if device is not None and not _is_gpu(device):
            return func(tensor, *args, **kwargs)
        options = {} if layout is None else {"memory_format": layout}
        return func(tensor, dtype or tensor.dtype, copy=copy, **options)

    def _cuda(self, func: Any, tensor: OnGpu, *_: Any, **__: Any) -> Any:
        return tensor

    def _unravel(self, func: Any, tensor: OnGpu, shape: Any) -> Any:
        for _ in range(2):
            self.gpu.wait(f"unravel_index, {COPIED}")
        return tuple(map(OnGpu, func(tensor.values, shape)))

    def _index(self, func: Any, tensor: OnGpu, index: Any, *value: Any) -> Any:
        many = isinstance(index, tuple)
        moved = tuple(map(self._moved, index if many else (index,)))
        return func(tensor, moved if many else moved[0], *value)

    def _moved(self, index: Any) -> Any:
        """Move an index to the device."""
        host = isinstance(index, Tensor) and not isinstance(index, OnGpu) and index.ndim
        if not host and not isinstance(index, list):
            return index
        self.gpu.wait(f"an index {COPIED}")
        return OnGpu(torch.as_tensor(index))

    ANSWERS = {
        "tolist": _tolist,
        "numpy": _numpy,
        "new_tensor": _new_tensor,
        "to": _to,
        "cuda": _cuda,
        "unravel_index": _unravel,
        "getitem": _index,
        "setitem": _index,
    }


def _is_gpu(device: Any) -> bool:
    """Whether the arguments name the emulated device."""
    return device is not None and torch.device(device).type in ("cuda", "meta")


def _numbered(x: Any) -> Any:
    """Add the device index to "cuda", which C++ would query; return anything else unchanged."""
    return GPU if isinstance(x, str | torch.device) and str(x) == "cuda" else x
