"""Checks of measured views."""

import torch
from jaxtyping import Float
from torch import Tensor


def check_finite(views: Float[Tensor, "b c m v u"]) -> None:
    """Refuse measured views with NaN or infinite values; an exported program (`torch.export`),
    which cannot raise by values, goes without the check.

    Raises:
        ValueError: values that are not finite.
    """
    if torch.compiler.is_exporting():
        return
    if not views.isfinite().all():
        bad = int((~views.isfinite()).sum())
        raise ValueError(
            f"Views must be finite, got {bad} of {views.numel()} values that are NaN or infinite"
        )
