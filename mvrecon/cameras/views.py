"""Checks of measured views."""

from jaxtyping import Float
from torch import Tensor


def check_finite(views: Float[Tensor, "b c m v u"]) -> None:
    """Refuse measured views with NaN or infinite values.

    Raises:
        ValueError: values that are not finite.
    """
    if not views.isfinite().all():
        bad = int((~views.isfinite()).sum())
        raise ValueError(
            f"Views must be finite, got {bad} of {views.numel()} values that are NaN or infinite"
        )
