"""A pinhole's opening: the area that lets counts through, the width that blurs, the cone that
accepts.

A knife edge of opening angle a lets some rays through its rim. They make the hole larger, for
sensitivity by

    d_e = sqrt(d (d + (2 / mu_c) tan(a / 2)))                            (Anger 1967)
    d_e = sqrt(d^2 + (2 d / mu_c) tan(a / 2) + (2 / mu_c^2) tan^2(a / 2))  (Paix 1967)

and for resolution by d_re = d + (ln 2 / mu_c) tan(a / 2), where half of the rays come through
(Metzler & Accorsi, Phys. Med. Biol. 50 (2005) 5005), at normal incidence.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor

from mvrecon.geometry.cameras.camera import Cameras

#: Linear attenuation in 1/mm that no collimator reaches from 70 keV up (tungsten above its K edge
#: 22), and that lead and tungsten at 140.5 keV in 1/cm exceed.
DENSEST_EDGE = 25.0


@dataclass(frozen=True)
class Hole:
    """A pinhole of a knife edge, round or rectangular.

    Args:
        size_mm: the diameter of a round hole, or the sides (u, v) of a rectangular one.
        collimator_mu: linear attenuation of the collimator in 1/mm, at 140.5 keV lead 2.692,
            tungsten 3.604; None: nothing comes through the rim.
        opening_degrees: the full opening angle a of the edge.
        acceptance_degrees: the greatest angle between a ray and the pinhole's axis at which counts
            come through; None: any.
        sensitivity: the law for d_e.

    Raises:
        ValueError: sizes, attenuation or angles out of their range, or an unknown law.
    """

    size_mm: float | Sequence[float] = 2.3
    collimator_mu: float | None = None
    opening_degrees: float = 90.0
    acceptance_degrees: float | None = None
    sensitivity: Literal["anger", "paix"] = "anger"

    def __post_init__(self) -> None:
        sizes = self.sides if _is_size(self.size_mm) else ()
        if len(sizes) != 2 or not all(0 < side < math.inf for side in sizes):
            raise ValueError(
                f"A pinhole's diameter must be positive mm, got {self.size_mm}; a rectangular "
                "one has two sides (u, v)"
            )
        if self.collimator_mu is not None and not 0 < self.collimator_mu <= DENSEST_EDGE:
            raise ValueError(
                f"A collimator's attenuation must be positive 1/mm, at most {DENSEST_EDGE:g} "
                f"(tungsten at 140.5 keV: 3.604), got {self.collimator_mu}; is it in 1/cm?"
            )
        if not 0 <= self.opening_degrees < 180:
            raise ValueError(
                f"Expected an opening angle from 0 to below 180 degrees, got {self.opening_degrees}"
            )
        if self.acceptance_degrees is not None and not 0 < self.acceptance_degrees <= 90:
            raise ValueError(
                "Expected an acceptance angle above 0, to 90 degrees from the axis, got "
                f"{self.acceptance_degrees}"
            )
        if self.sensitivity not in ("anger", "paix"):
            raise ValueError(f"Expected the law 'anger' or 'paix', got {self.sensitivity!r}")

    def check_way(self, cameras: Cameras) -> None:
        """Check that the hole is smaller than its way to every detector.

        Raises:
            ValueError: it is as wide: cm and mm are mixed up.
        """
        way = cameras.distance.detach().min().item()
        if max(self.sides) >= way:
            raise ValueError(
                f"Expected a hole smaller than its way to the detector, {way:g} mm, got "
                f"{max(self.sides):g} mm; look at mm and cm of hole and camera"
            )

    @property
    def round(self) -> bool:
        """Whether the hole is a disc."""
        return isinstance(self.size_mm, int | float)

    @property
    def sides(self) -> tuple[float, ...]:
        """Widths in mm along u and v."""
        size = self.size_mm
        both = (size, size) if isinstance(size, int | float) else tuple(size)
        return tuple(float(side) for side in both)

    @property
    def rim(self) -> float:
        """The length tan(a / 2) / mu_c in mm of the rim that lets rays through."""
        if self.collimator_mu is None:
            return 0.0
        return math.tan(math.radians(self.opening_degrees) / 2) / self.collimator_mu

    @property
    def effective_mm(self) -> tuple[float, ...]:
        """Effective widths d_e in mm for sensitivity, along u and v."""
        more = 2 * self.rim**2 if self.sensitivity == "paix" else 0.0
        return tuple(math.sqrt(d * (d + 2 * self.rim) + more) for d in self.sides)

    @property
    def blurring_mm(self) -> tuple[float, ...]:
        """Effective widths d_re in mm for resolution, along u and v."""
        return tuple(d + math.log(2) * self.rim for d in self.sides)

    def weight(self, cameras: Cameras) -> Float[Tensor, "m v u"]:
        """Sensitivity of each pixel, counts per line integral, in mm^2: the hole's effective area
        times cos^4(phi) du dv / (4 pi l^2), d_e^2 cos^4(phi) du dv / (16 l^2) for a round one; zero
        beyond the angle of acceptance.
        """
        start, end = cameras.rays()
        distance = cameras.distance[:, None, None]
        cosine = distance / (end - start).norm(dim=-1)
        area = torch.linalg.cross(cameras.u, cameras.v).norm(dim=-1)[:, None, None]
        width, height = self.effective_mm
        share = width * height / 16 if self.round else width * height / (4 * math.pi)
        weight = share * cosine**4 * area / distance**2
        if self.acceptance_degrees is None:
            return weight
        return weight * (cosine >= math.cos(math.radians(self.acceptance_degrees)))


def _is_size(size: object) -> bool:
    """Whether a value is a number, or a sequence of numbers."""
    numbers = size if isinstance(size, Sequence) and not isinstance(size, str) else (size,)
    return all(isinstance(n, int | float) and not isinstance(n, bool) for n in numbers)
