"""Views as they come from a measurement."""

from jaxtyping import Float
from torch import Tensor


def check_finite(views: Float[Tensor, "b c m v u"]) -> None:
    """The door for measured values.

    Raises:
        ValueError: values that are not finite.
    """
    if not views.isfinite().all():
        bad = int((~views.isfinite()).sum())
        raise ValueError(
            f"Views must be finite, got {bad} of {views.numel()} values that are NaN or infinite"
        )
