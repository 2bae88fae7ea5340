"""Checks of measured views."""

import torch
from jaxtyping import Float
from torch import Tensor


def check_finite(views: Float[Tensor, "b c m v u"], on_gpu: bool = True) -> None:
    """Refuse measured views with NaN or infinite values; an exported program (`torch.export`),
    which cannot raise by values, goes without the check.

    Args:
        views: measured.
        on_gpu: whether views on a GPU are checked, too, whose answer is waited for. False is for
            callers whose results are then not finite either.

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
