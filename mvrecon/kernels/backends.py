"""Which back end serves a tensor."""

from collections.abc import Callable
from importlib.util import find_spec
from types import ModuleType
from typing import Any

from torch import Tensor

from mvrecon.kernels.rays import ops, reference

BACKENDS = ("auto", "cpu", "cuda", "reference")
COMPILED = find_spec("numba") is not None


def kernels_for(
    tensor: Tensor,
    backend: str,
    purpose: str | None = None,
    tried: Callable[..., Any] | None = None,
) -> tuple[str, ModuleType]:
    """The back end's name and its functions along rays, for volumes or views [b c ..].

    Args:
        tensor: what is to be projected or back-projected.
        backend: "auto" takes the compiled one of the tensor's device where that can be had, else
            the reference.
        purpose: the method of rays, or what else the kernels are for, of which the name alone
            tells; without it a GPU has none but the reference.
        tried: of another purpose, what its kernels are tried on, see `selfcheck.reason`.

    Raises:
        ValueError: an unknown back end, or a compiled one for a tensor elsewhere.
        RuntimeError: "cuda" was asked for, and its kernels cannot be used; the reason is told.
    """
    if backend not in BACKENDS:
        raise ValueError(f"Unknown backend {backend!r}. Known: {', '.join(BACKENDS)}")
    device = tensor.device.type
    if backend in ("cpu", "cuda") and device != backend:
        memory = "main memory" if backend == "cpu" else "a GPU's memory"
        raise ValueError(
            f"backend {backend!r} needs tensors in {memory}, got {tensor.device}; use 'auto' or "
            f"'reference'"
        )
    if backend == "reference" or not COMPILED:
        return "reference", reference
    if device == "cuda":
        from mvrecon.kernels.rays.cuda import selfcheck

        volumes = tensor.shape[0] * tensor.shape[1]
        why = (
            selfcheck.reason(tensor.device, purpose, tensor.dtype, volumes, tried)
            if purpose
            else "there are no such kernels"
        )
        if why and backend == "cuda":
            raise RuntimeError(f"backend 'cuda' cannot be used on {tensor.device}: {why}")
        return ("reference", reference) if why else ("cuda", ops)
    return ("cpu", ops) if device == "cpu" else ("reference", reference)
