"""A flat detector, its pixels and pitch in mm, and the record of cameras that have it."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, fields
from numbers import Real
from typing import Any

from jaxtyping import Float
from torch import Tensor

from mvrecon.core.registry import check_options
from mvrecon.geometry.cameras.camera import Cameras, Extent


@dataclass(frozen=True)
class Detector:
    """A flat detector. Pairs are in the order (v, u): down a column, along a row; one number stands
    for both.

    Args:
        pixels: rows and columns.
        pixel_mm: pitch of the rows and of the columns.
        offset_mm: shift of the detector's centre down and to the right, as the source sees it.

    Raises:
        ValueError: sizes that are not positive, or not one or two finite numbers.
    """

    pixels: tuple[int, int]
    pixel_mm: tuple[float, float]
    offset_mm: tuple[float, float] = (0.0, 0.0)

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            pair = tuple(value) if isinstance(value, list | tuple) else (value, value)
            if len(pair) != 2 or not all(isinstance(x, Real) and math.isfinite(x) for x in pair):
                raise ValueError(
                    f"A detector's {field.name} must be one number or two (v, u), got {value!r}"
                )
            object.__setattr__(self, field.name, pair)
        if not (all(x == int(x) and x >= 1 for x in self.pixels) and min(self.pixel_mm) > 0):
            raise ValueError(
                "A detector needs positive whole pixels and a positive pixel_mm, "
                f"got pixels {self.pixels} and pixel_mm {self.pixel_mm}"
            )

    @classmethod
    def of(cls, options: Mapping[str, Any]) -> "Detector":
        """The detector that a mapping describes; an option that is None counts as absent.

        Raises:
            TypeError: not a mapping, an unknown option, or a missing one; the message names it.
        """
        known = [field.name for field in fields(cls)]
        if not isinstance(options, Mapping):
            raise TypeError(f"A detector must be a mapping of {', '.join(known)}, got {options!r}")
        check_options("A detector", options, known)
        options = {name: value for name, value in options.items() if value is not None}
        if absent := {"pixels", "pixel_mm"} - set(options):
            raise TypeError(
                f"A detector needs {' and '.join(sorted(absent))}, got only {sorted(options)}"
            )
        return cls(**options)

    def carried(
        self,
        source: Float[Tensor, "m 3"],
        centre: Float[Tensor, "m 3"],
        R: Float[Tensor, "m 3 3"],
        parallel: bool = False,
        extent: Extent = "segment",
    ) -> Cameras:
        """Cameras with this detector.

        Args:
            source: sources or pinholes in mm; for parallel beams, where the beam's axis starts.
            centre: where the detector's centre is in mm, but for `offset_mm`.
            R: rows right, down and forward as seen from the source towards the object (`look_at`).
            parallel, extent: as in `Cameras`.
        """
        (down, right), (rows, columns) = self.pixel_mm, self.pixels
        u, v = R[:, 0] * right, R[:, 1] * down
        offset = R[:, 0] * self.offset_mm[1] + R[:, 1] * self.offset_mm[0]
        corner = offset - u * (columns - 1) / 2 - v * (rows - 1) / 2
        return Cameras(
            source=source + corner if parallel else source,
            origin=centre + corner,
            u=u,
            v=v,
            shape=self.pixels,
            parallel=parallel,
            extent=extent,
        )


def detector_centre(cameras: Cameras) -> Float[Tensor, "m 3"]:
    """Where the middle of each detector is, in mm."""
    rows, columns = cameras.shape
    return cameras.origin + cameras.u * (columns - 1) / 2 + cameras.v * (rows - 1) / 2
