"""Optimisers and learning-rate schedules by name."""

import math
from collections.abc import Iterable
from typing import Any

import torch
from torch import Tensor
from torch.optim.lr_scheduler import LambdaLR

from mvrecon.parts import OPTIMIZERS
from mvrecon.registry import hint

SCHEDULES = ("cosine", "one_cycle", "constant")


def share(name: str, step: int, steps: int, warmup: float) -> float:
    """The share of the highest learning rate at a step.

    "cosine" and "constant" rise linearly over the first `warmup` of the steps, "one_cycle" along
    half a cosine from 1/25; "cosine" and "one_cycle" then fall to zero along half a cosine
    (Loshchilov & Hutter 2017; Smith & Topin 2019).
    """
    rise = warmup * steps
    if step < rise and name == "one_cycle":
        return 1 - (1 - 1 / 25) * 0.5 * (1 + math.cos(math.pi * step / rise))
    if step < rise:
        return (step + 1) / (rise + 1)
    if name == "constant":
        return 1.0
    return 0.5 * (1 + math.cos(math.pi * min(1.0, (step - rise) / max(1.0, steps - rise))))


def build_optimizer(
    parameters: Iterable[Tensor], name: str, **options: Any
) -> torch.optim.Optimizer:
    """An optimiser by its short name: one of torch's, or a plugin's.

    Raises:
        LookupError: an unknown name.
        TypeError: an option that it does not have.
    """
    return OPTIMIZERS.build(name, parameters, **options)


def build_schedule(
    optimizer: torch.optim.Optimizer, name: str, steps: float, warmup: float = 0.0
) -> LambdaLR:
    """A learning-rate schedule over a known number of optimiser steps; see `share`.

    Raises:
        LookupError: an unknown name.
        ValueError: a number of steps that is not known, or a warm-up that is not in [0, 1).
    """
    if name not in SCHEDULES:
        raise LookupError(f"No schedule is named {name!r}{hint(name, SCHEDULES)}")
    if not 0 <= warmup < 1:
        raise ValueError(f"warmup must be a share of the steps in [0, 1), got {warmup}")
    if not 0 < steps < math.inf:
        raise ValueError(
            f"A schedule needs to know the number of steps, got {steps}; set trainer.max_steps"
        )
    return LambdaLR(optimizer, lambda step: share(name, step, int(steps), warmup))
