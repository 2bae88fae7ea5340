"""Means over the cases of a validation, whichever process has judged them."""

from collections.abc import Mapping

from jaxtyping import Float
from torch import Tensor
from torchmetrics import MeanMetric


class Means:
    """Means by name, over all cases and all processes of a run (torchmetrics' MeanMetric, which
    sums over them); a case whose figure is nan makes the mean nan.
    """

    def __init__(self) -> None:
        self._means: dict[str, MeanMetric] = {}

    def update(self, values: Mapping[str, Float[Tensor, " n"]]) -> None:
        """Add the figures of n cases, which may be none, each by itself: torchmetrics 1.9 leaves a
        weight out where nan counts.
        """
        for name, value in values.items():
            if name not in self._means:
                self._means[name] = MeanMetric(nan_strategy="disable").to(value.device)
            self._means[name].update(value.detach())

    def compute(self) -> dict[str, Tensor]:
        """The means by name, and begin anew; all processes call this together."""
        means = {name: self._means[name].compute() for name in sorted(self._means)}
        self._means.clear()
        return means
