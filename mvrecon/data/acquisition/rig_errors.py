"""What is wrong with the views of one case, and what such cameras see."""

from dataclasses import dataclass, fields, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from mvrecon.geometry.cameras.camera import Cameras
from mvrecon.geometry.cameras.misalignment import Misalignment, misaligned


@dataclass(frozen=True, eq=False, kw_only=True)
class RigErrors:
    """What is wrong with the views of one case.

    Args:
        shift_px: of each detector along its columns' and its rows' direction (u, v), in pixels.
        gain: factor of each view; 0 where the view is lost.
        tilt_deg: turns of each detector about its middle, as those of `Misalignment`.
        motion_mm: where the object was when each view was taken, along x, y and z.
        saturated: share of the view's greatest value below which pixels read just that.
        truncated: share of columns that read zero, the last ones; where negative, the first ones.
    """

    shift_px: Float[Tensor, "m 2"]
    gain: Float[Tensor, " m"]
    tilt_deg: Float[Tensor, "m 3"]
    motion_mm: Float[Tensor, "m 3"]
    saturated: Float[Tensor, " m"]
    truncated: Float[Tensor, " m"]

    @classmethod
    def none(cls, m: int) -> "RigErrors":
        """No error of any of m cameras."""
        zero, three = torch.zeros(m, dtype=torch.float64), torch.zeros(m, 3, dtype=torch.float64)
        return cls(
            shift_px=three[:, :2],
            gain=zero + 1,
            tilt_deg=three,
            motion_mm=three,
            saturated=zero,
            truncated=zero,
        )

    def wrong(self) -> Bool[Tensor, " m"]:
        """Which views are wrong in any way."""
        none, wrong = RigErrors.none(len(self.gain)), torch.zeros(len(self.gain), dtype=torch.bool)
        for field in fields(self):
            off = getattr(self, field.name) != getattr(none, field.name)
            wrong |= off.reshape(len(off), -1).any(dim=1)
        return wrong

    def record(self) -> dict[str, Tensor]:
        """Every error by its name, float32, and which views are "wrong"."""
        errors = {field.name: getattr(self, field.name).float() for field in fields(self)}
        return {**errors, "wrong": self.wrong()}

    def rig(self, cameras: Cameras) -> Cameras:
        """The cameras where they are in truth, relative to the object.

        Raises:
            ValueError: tilts of parallel beams.
        """
        moved = cameras.shifted(self.shift_px.to(cameras.source))
        if self.tilt_deg.any():
            turns = self.tilt_deg.to(moved.source)
            still = Misalignment.none(len(cameras))
            moved = misaligned(moved, still._replace(tilt_degrees=turns))
        # the object's motion is the cameras' the other way
        step = -self.motion_mm.to(moved.source)
        return replace(moved, source=moved.source + step, origin=moved.origin + step)

    def views(self, views: Float[Tensor, "1 m v u"]) -> Float[Tensor, "1 m v u"]:
        """What the detectors make of ideal views of the true rig, in the views' unit."""
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
    """One number of each view, as it multiplies views."""
    return number.to(views)[:, None, None]
