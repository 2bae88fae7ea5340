"""Views that are wrong in a way that nobody knows: detectors that moved, gains that drifted."""

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields
from typing import Any, NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from mvrecon.cameras.camera import Cameras
from mvrecon.registry import check_options


@dataclass(frozen=True, kw_only=True)
class Disturbance:
    """Rig errors of each case, unknown to whoever reconstructs: some views' detectors are shifted
    by pixels, and their values have a wrong gain.

    Args:
        views: so many of a case's views, drawn for each case.
        shift_px: of the detector along columns and along rows, uniform between minus and plus this.
        gain: of the views' values, 1 + a number uniform between minus and plus this.
        share: of the cases that have such errors, 0 to 1; the others have none.

    Raises:
        TypeError: an option that is no number.
        ValueError: numbers below 0 or not finite, a gain of 1 or more, a share above 1, views that
            are no whole number of at least 1.
    """

    views: int = 1
    shift_px: float = 0.0
    gain: float = 0.0
    share: float = 1.0

    def __post_init__(self) -> None:
        for name, value in asdict(self).items():
            if not isinstance(value, int | float) or isinstance(value, bool):
                raise TypeError(f"Expected disturbed.{name} as a number, got {value!r}")
        if self.views < 1 or self.views != int(self.views):
            raise ValueError(
                f"Expected disturbed.views as a whole number of at least 1, got {self.views}"
            )
        if not 0 <= self.share <= 1:
            raise ValueError(f"Expected disturbed.share from 0 to 1, got {self.share}")
        if not (0 <= self.shift_px < math.inf and 0 <= self.gain < 1):
            raise ValueError(
                f"Expected disturbed.shift_px of at least 0 and disturbed.gain from 0 to below 1, "
                f"got {self.shift_px} and {self.gain}"
            )

    @classmethod
    def of(cls, options: Any) -> "Disturbance":
        """The disturbance that a mapping describes.

        Raises:
            TypeError: not a mapping, or an unknown option; the message gives the nearest.
        """
        known = [field.name for field in fields(cls)]
        if not isinstance(options, Mapping):
            raise TypeError(f"disturbed is a mapping of {', '.join(known)}, got {options!r}")
        check_options("disturbed", options, known)
        return cls(**options)


class RigErrors(NamedTuple):
    """What is wrong with the views of one case.

    Args:
        offset_px: shift of each detector along its columns' and its rows' direction (u, v), in
            pixels.
        gain: factor of each view.
    """

    offset_px: Float[Tensor, "m 2"]
    gain: Float[Tensor, "m 1 1"]

    def rig(self, cameras: Cameras) -> Cameras:
        """The cameras where they are in truth."""
        return cameras.shifted(self.offset_px.to(cameras.source))


def rig_errors(disturbance: Disturbance, cameras: Any, rng: torch.Generator) -> RigErrors:
    """The errors of one case, drawn at random: shifts in pixels and gains without a unit.

    Raises:
        ValueError: more views than cameras, or explicit rays, which have no detector.
    """
    if not isinstance(cameras, Cameras):
        raise ValueError(f"Expected cameras to disturb, got {type(cameras).__name__}")
    m, k = len(cameras), int(disturbance.views)
    if k > m:
        raise ValueError(f"Expected disturbed.views of at most the rig's {m} cameras, got {k}")
    chosen = torch.zeros(m, 1, dtype=torch.float64)
    chosen[torch.randperm(m, generator=rng)[:k]] = 1.0
    if disturbance.share < 1:
        chosen *= torch.rand((), generator=rng) < disturbance.share
    drawn = chosen * (2 * torch.rand(m, 3, generator=rng, dtype=torch.float64) - 1)
    offset, gain = drawn.split((2, 1), dim=1)
    return RigErrors(disturbance.shift_px * offset, 1 + disturbance.gain * gain[..., None])
