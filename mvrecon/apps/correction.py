"""A scan after correction of its views or calibration of its cameras."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

from jaxtyping import Bool, Float
from torch import Tensor

from mvrecon.apps.scan import Scan
from mvrecon.core.parts import CORRECTIONS
from mvrecon.data.projections.views import Corrected
from mvrecon.methods.calibration.alignment import Alignment


@dataclass(frozen=True, eq=False)
class ViewsInMemory:
    """Views that are read no more, in the place of `MeasuredViews`.

    Args:
        views: line integrals.
        mask: pixels that were measured.
    """

    views: Float[Tensor, "m v u"]
    mask: Bool[Tensor, "m v u"]

    def read(self, first: int, last: int) -> Corrected:
        """Views `first` to `last - 1`."""
        return Corrected(self.views[first:last], self.mask[first:last])

    def whole(self) -> Corrected:
        """All views."""
        return Corrected(self.views, self.mask)

    def divided_by(self, gains: Float[Tensor, " m"]) -> "ViewsInMemory":
        """The same views with each one's integrals divided by its gain."""
        return replace(self, views=self.views / gains[:, None, None])

    def warn_of_values(self, saturated: int, floored: int) -> None:
        """No warning: it came when the views were read."""


def check(settings: Mapping[str, Any]) -> None:
    """Check the settings `correct` and `self_calibrate` before any view is read.

    Raises:
        LookupError, TypeError: no such correction, or no such option of it.
        ValueError: calibration without a correction that tells what is wrong with the cameras.
    """
    correct, calibrate = settings["correct"], settings["self_calibrate"]
    if correct is not None:
        CORRECTIONS.check(correct)
    if calibrate and correct is None:
        raise ValueError("expected correct=align for self_calibrate=true, got correct=null")


def corrected_scan(
    scan: Scan, settings: Mapping[str, Any], device: str = "cpu"
) -> tuple[Scan, Alignment | None]:
    """The scan with corrected views, by the setting `correct`, and what is wrong with its cameras
    where that is known.

    With `self_calibrate` no view is moved: each camera is where its view says, and gains alone are
    undone.

    Raises:
        ValueError: pixels that were not measured; what the correction raises.
    """
    if settings["correct"] is None:
        return scan, None
    whole = scan.measured.whole()
    if missing := int((~whole.mask).sum()):
        raise ValueError(
            f"expected every pixel to be measured for correct={settings['correct']['name']}, got "
            f"{missing} dead or saturated ones; crop them by views.rows and views.columns"
        )
    views = whole.views[None, None].to(device)
    corrected, by = CORRECTIONS.from_config(settings["correct"], scan.operator().to(device), views)
    by = None if by is None else by.to("cpu")
    if by is not None and settings["self_calibrate"]:
        measured = ViewsInMemory(whole.views, whole.mask).divided_by(by.gain[0])
        cameras = scan.cameras.shifted(by.shift_px[0].to(scan.cameras.origin))
        return replace(scan, measured=measured, cameras=cameras), by
    return replace(scan, measured=ViewsInMemory(corrected[0, 0].cpu(), whole.mask)), by
