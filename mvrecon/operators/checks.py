"""Checks of the tensors that are passed to operators and methods: shapes, devices, types, finite
values.
"""

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from mvrecon.geometry.cameras.camera import Cameras


def check(tensor: Tensor, what: str, sizes: Sequence[int], device: torch.device) -> None:
    """Raise ValueError unless a tensor [b c ...] has these last sizes and lies on the device."""
    if not isinstance(tensor, Tensor):
        raise TypeError(
            f"Expected {what} as a tensor, got {type(tensor).__name__}; torch.as_tensor makes one "
            f"of an array"
        )
    if tensor.ndim != 2 + len(sizes) or tuple(tensor.shape[2:]) != tuple(sizes):
        raise ValueError(
            f"Expected {what} with last sizes {tuple(sizes)}, got {tuple(tensor.shape)}"
            + _axes_hint(tensor, sizes)
        )
    if tensor.device != device:
        raise ValueError(
            f"Expected {what} on {device}, where the projector is, got {tensor.device}"
        )


def check_measured(tensor: Tensor, what: str, sizes: Sequence[int], device: torch.device) -> None:
    """Check views or counts for a reconstruction: as `check`, and not empty.

    Raises:
        ValueError: a wrong rank, size or device, or an empty batch.
    """
    check(tensor, what, sizes, device)
    if not tensor.numel():
        raise ValueError(
            f"Expected {what} of at least one sample and one channel, got {tuple(tensor.shape)}"
        )


def _axes_hint(tensor: Tensor, sizes: Sequence[int]) -> str:
    """A hint on adding missing batch and channel axes; empty for any other tensor."""
    if tuple(tensor.shape[-3:]) != tuple(sizes) or tensor.ndim not in (3, 4):
        return ""
    return "; for one sample of one channel use " + (
        "x[None, None]"
        if tensor.ndim == 3
        else "x[:, None] where the first axis is the batch, x[None] where it is the channel"
    )


def check_floating(tensor: Tensor, what: str) -> None:
    """Raise ValueError for integers and masks, which would silently be rounded to float32 and have
    no gradient.
    """
    if not tensor.is_floating_point():
        raise ValueError(
            f"Expected {what} of floating point, got {tensor.dtype}; convert it, as by .float()"
        )


def check_views(views: Float[Tensor, "b c m v u"], cameras: Cameras) -> None:
    """Check the shape of measured views, and on the CPU that all values are finite.

    Raises:
        ValueError: a wrong rank or size, an empty batch, or values that are not finite.
    """
    check_measured(views, "views [b c m v u]", (len(cameras), *cameras.shape), views.device)
    check_finite(views, on_gpu=False)


def check_finite(views: Float[Tensor, "b c m v u"], on_gpu: bool = True) -> None:
    """Raise if measured views hold NaN or infinite values; skipped in an exported program
    (`torch.export`), which cannot raise by values.

    Args:
        views: measured views.
        on_gpu: also check views on a GPU, which synchronises. False is for callers whose results
            are then not finite either.

    Raises:
        ValueError: values that are not finite.
    """
    if torch.compiler.is_exporting() or not (on_gpu or views.is_cpu):
        return
    if not views.isfinite().all():
        bad = int((~views.isfinite()).sum())
        raise ValueError(
            f"Views must be finite, got {bad} of {views.numel()} values that are NaN or infinite"
        )
