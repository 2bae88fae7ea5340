"""The check that a training's loss is finite."""

from collections.abc import Mapping

import torch
from jaxtyping import Float
from torch import Tensor


class FiniteLoss:
    """Check that the terms of every loss are finite: in main memory at once, on a GPU some steps at
    a time, since each answer has to be waited for.

    Args:
        model: its name, for the error.
    """

    def __init__(self, model: str):
        self.model = model
        self._steps: list[int] = []
        self._names: list[str] = []
        self._terms: list[Float[Tensor, " k"]] = []

    def add(self, step: int, terms: Mapping[str, Float[Tensor, ""]], together: int) -> None:
        """Check the terms of a step, or those of as many steps as go together.

        Raises:
            FloatingPointError: a total that is not finite, with the first such step's terms.
        """
        self._names = list(terms)
        self._steps.append(step)
        self._terms.append(torch.stack([value.detach() for value in terms.values()]))
        if self._terms[0].is_cpu or len(self._terms) >= together:
            self.look()

    def look(self) -> None:
        """Check all steps that have not been checked yet.

        Raises:
            FloatingPointError: as `add`.
        """
        steps, self._steps, terms, self._terms = self._steps, [], self._terms, []
        if not terms:
            return
        for step, values in zip(steps, torch.stack(terms).cpu(), strict=True):
            shown = dict(zip(self._names, values, strict=True))
            if not shown["total"].isfinite():
                text = ", ".join(f"{name} {value.item():.4g}" for name, value in shown.items())
                raise FloatingPointError(
                    f"The loss of {self.model} is not finite at step {step}: {text}. Lower "
                    f"optimizer.lr, set trainer.gradient_clip_val, or look for bad values in the "
                    f"data"
                )
