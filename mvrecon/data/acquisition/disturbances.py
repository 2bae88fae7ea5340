"""Unknown errors of views: their options, and their values for a case."""

import math
from dataclasses import asdict, dataclass, fields, replace
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from mvrecon.geometry.cameras.camera import Cameras
from mvrecon.geometry.cameras.random_rigs import Misalignment, misaligned


@dataclass(frozen=True, eq=False, kw_only=True)
class RigErrors:
    """The errors of the views of one case.

    Args:
        shift_px: of each detector along its columns' and its rows' direction (u, v), in pixels.
        gain: factor of each view; 0 where the view is lost.
        tilt_deg: rotations of each detector about its centre, as those of `Misalignment`.
        motion_mm: displacement of the object in each view, along x, y and z.
        saturated: values are clipped to this share of the view's greatest value.
        truncated: share of columns that read zero, the last ones; if negative, the first ones.
    """

    shift_px: Float[Tensor, "m 2"]
    gain: Float[Tensor, " m"]
    tilt_deg: Float[Tensor, "m 3"]
    motion_mm: Float[Tensor, "m 3"]
    saturated: Float[Tensor, " m"]
    truncated: Float[Tensor, " m"]

    def record(self) -> dict[str, Tensor]:
        """Every error by its name, float32, and which views are faulty in any way ("wrong")."""
        errors = {field.name: getattr(self, field.name) for field in fields(self)}
        off = torch.column_stack([*{**errors, "gain": self.gain - 1}.values()])
        return {name: value.float() for name, value in errors.items()} | {
            "wrong": (off != 0).any(dim=1)
        }

    def rig(self, cameras: Cameras) -> Cameras:
        """The true cameras, relative to the object."""
        moved = cameras.shifted(self.shift_px.to(cameras.source))
        if self.tilt_deg.any():
            turns = self.tilt_deg.to(moved.source)
            still = Misalignment.none(len(cameras))
            moved = misaligned(moved, still._replace(tilt_degrees=turns))
        # motion of the object is opposite motion of the cameras
        step = -self.motion_mm.to(moved.source)
        return replace(moved, source=moved.source + step, origin=moved.origin + step)

    def views(self, views: Float[Tensor, "1 m v u"]) -> Float[Tensor, "1 m v u"]:
        """Apply the detectors' errors to ideal views of the true rig, in the views' unit."""
        if self.saturated.any():
            least = views.amax(dim=(2, 3), keepdim=True) * _each(self.saturated, views)
            views = torch.where(_each(self.saturated, views) > 0, views.maximum(least), views)
        views = views * _each(self.gain, views)
        if self.truncated.any():
            columns = views.shape[-1]
            dark = (self.truncated * columns).round()[:, None]
            index = torch.arange(columns, dtype=dark.dtype)
            read = (index >= -dark) & (index < columns - dark)
            views = views * read[:, None].to(views)
        return views


def _each(number: Float[Tensor, " m"], views: Float[Tensor, "1 m v u"]) -> Tensor:
    """One number for each view, shaped to multiply views."""
    return number.to(views)[:, None, None]


#: Options that count views, with their least values.
MIN_VIEW_COUNTS = {"views": 1, "lost": 0}
#: Upper bounds of options; others must be finite.
UPPER_BOUNDS = {"gain": 1.0, "tilt_deg": 45.0, "saturated": 1.0, "truncated": 1.0}


@dataclass(frozen=True, kw_only=True)
class Disturbance:
    """Errors of each case, unknown to the reconstruction: some views' detectors are shifted
    (pixels) and tilted (degrees), the object moved (mm), values scaled, clipped, cut off or lost.

    Args:
        views: number of views, drawn for each case, with all errors but `lost`.
        shift_px: of the detector along columns and rows, uniform in +-this.
        gain: of the views' values, 1 + a number uniform in +-this.
        tilt_deg: of the detector about its centre, rotations about its columns' and rows'
            directions and its normal, each uniform in +-this.
        motion_mm: of the object during the view, along x, y and z, each uniform in +-this.
        saturated: share of a view's greatest value at which an overexposed detector clips.
        truncated: share of a detector's columns, at its left or right end, that read zero.
        lost: number of views, drawn independently, that read zero everywhere.
        probability: that each of the drawn views is faulty, or lost; 1: all are.

    Raises:
        TypeError: an option that is no number.
        ValueError: numbers below 0, not finite or too large; numbers of views that are not whole.
    """

    views: int = 1
    shift_px: float = 0.0
    gain: float = 0.0
    tilt_deg: float = 0.0
    motion_mm: float = 0.0
    saturated: float = 0.0
    truncated: float = 0.0
    lost: int = 0
    probability: float = 1.0

    def __post_init__(self) -> None:
        for name, value in asdict(self).items():
            if not isinstance(value, int | float) or isinstance(value, bool):
                raise TypeError(f"Expected disturbed.{name} as a number, got {value!r}")
            if name in MIN_VIEW_COUNTS:
                expected = f"a whole number of at least {MIN_VIEW_COUNTS[name]}"
                fits = MIN_VIEW_COUNTS[name] <= value < math.inf and value == int(value)
            elif name == "probability":
                expected, fits = "a number from 0 to 1", 0 <= value <= 1
            elif name in UPPER_BOUNDS:
                expected = f"a number from 0 to below {UPPER_BOUNDS[name]:g}"
                fits = 0 <= value < UPPER_BOUNDS[name]
            else:
                expected, fits = "a number of at least 0", 0 <= value < math.inf
            if not fits:
                raise ValueError(f"Expected disturbed.{name} as {expected}, got {value}")


def rig_errors(disturbance: Disturbance, cameras: Any, rng: torch.Generator) -> RigErrors:
    """Draw the errors of one case: shifts in pixels, tilts in degrees, motions in mm, gains and
    shares without a unit.

    Raises:
        ValueError: more views than cameras, or explicit rays, which have no detector.
    """
    if not isinstance(cameras, Cameras):
        raise ValueError(f"Expected cameras to disturb, got {type(cameras).__name__}")
    m = len(cameras)
    for name in MIN_VIEW_COUNTS:
        if (count := getattr(disturbance, name)) > m:
            raise ValueError(
                f"Expected disturbed.{name} of at most the rig's {m} cameras, got {count}"
            )
    chosen = _drawn(m, disturbance.views, rng)
    # shifts and gains first, so that cases of older runs stay the same
    offset, gain = _uniform(m, 3, rng).split((2, 1), dim=1)
    tilt, motion, side = _uniform(m, 7, rng).split((3, 3, 1), dim=1)
    lost = _drawn(m, disturbance.lost, rng)
    wrong, missing = (torch.rand(2, m, 1, generator=rng) < disturbance.probability).double()
    chosen, lost = chosen * wrong, lost * missing
    return RigErrors(
        shift_px=disturbance.shift_px * chosen * offset,
        gain=((1 + disturbance.gain * chosen * gain) * (1 - lost))[:, 0],
        tilt_deg=disturbance.tilt_deg * chosen * tilt,
        motion_mm=disturbance.motion_mm * chosen * motion,
        saturated=(disturbance.saturated * chosen)[:, 0],
        truncated=(disturbance.truncated * chosen * torch.where(side < 0, -1, 1))[:, 0],
    )


def _drawn(m: int, count: float, rng: torch.Generator) -> Float[Tensor, "m 1"]:
    """1 for a random selection of so many of m cameras, 0 for the others."""
    chosen = torch.zeros(m, 1, dtype=torch.float64)
    chosen[torch.randperm(m, generator=rng)[: int(count)]] = 1.0
    return chosen


def _uniform(m: int, count: int, rng: torch.Generator) -> Float[Tensor, "m count"]:
    return 2 * torch.rand(m, count, generator=rng, dtype=torch.float64) - 1
