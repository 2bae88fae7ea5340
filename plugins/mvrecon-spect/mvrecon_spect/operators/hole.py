"""A pinhole's opening: effective area for sensitivity, effective width for resolution, and
acceptance cone.

Some rays penetrate the rim of a knife edge with opening angle a, which enlarges the hole. The
effective diameter for sensitivity is

    d_e = sqrt(d (d + (2 / mu_c) tan(a / 2)))                            (Anger 1967)
    d_e = sqrt(d^2 + (2 d / mu_c) tan(a / 2) + (2 / mu_c^2) tan^2(a / 2))  (Paix 1967)

and for resolution d_re = d + (ln 2 / mu_c) tan(a / 2), where half of the rays are transmitted
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

#: Upper bound of a collimator's linear attenuation in 1/mm above 70 keV (tungsten above its K edge:
#: 22); lead and tungsten at 140.5 keV in 1/cm exceed it.
DENSEST_EDGE = 25.0
#: Tolerance of the cosine of the acceptance angle, above rounding to float32.
ROUNDING = 1e-5


@dataclass(frozen=True)
class Hole:
    """A round or rectangular knife-edge pinhole.

    Args:
        size_mm: diameter of a round hole, or sides (u, v) of a rectangular one.
        collimator_mu: linear attenuation of the collimator in 1/mm, at 140.5 keV lead 2.692,
            tungsten 3.604; None: opaque rim.
        opening_degrees: full opening angle a of the edge.
        acceptance_degrees: maximum angle between an accepted ray and the pinhole's axis; None: any.
        sensitivity: formula for d_e.

    Raises:
        ValueError: sizes, attenuation or angles out of range, or an unknown formula.
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
        """Check that the hole is smaller than its distance to every detector.

        Raises:
            ValueError: it is not smaller, which indicates cm instead of mm.
        """
        way = cameras.distance.detach().min().item()
        if max(self.sides) >= way:
            raise ValueError(
                f"Expected a hole smaller than its way to the detector, {way:g} mm, got "
                f"{max(self.sides):g} mm; look at mm and cm of hole and camera"
            )

    @property
    def round(self) -> bool:
        """Whether the hole is round."""
        return isinstance(self.size_mm, int | float)

    @property
    def sides(self) -> tuple[float, ...]:
        """Widths in mm along u and v."""
        size = self.size_mm
        both = (size, size) if isinstance(size, int | float) else tuple(size)
        return tuple(float(side) for side in both)

    @property
    def rim(self) -> float:
        """Penetration length tan(a / 2) / mu_c of the rim in mm."""
        if self.collimator_mu is None:
            return 0.0
        return math.tan(math.radians(self.opening_degrees) / 2) / self.collimator_mu

    @property
    def effective_mm(self) -> tuple[float, ...]:
        """Effective widths d_e in mm for sensitivity, along u and v."""
        more = 2 * self.rim**2 if self.sensitivity == "paix" else 0.0
        return tuple(math.sqrt(d * (d + 2 * self.rim) + more) for d in self.sides)

    @property
    def least_cosine(self) -> float:
        """Cosine of the greatest angle between an accepted ray and the axis; rays on the cone of
        acceptance are accepted, whatever the rounding.
        """
        degrees = self.acceptance_degrees
        return -1.0 if degrees is None else math.cos(math.radians(degrees)) - ROUNDING

    @property
    def area_mm2(self) -> float:
        """Effective area for sensitivity, in mm^2."""
        width, height = self.effective_mm
        return width * height * (math.pi / 4 if self.round else 1.0)

    @property
    def blurring_mm(self) -> tuple[float, ...]:
        """Effective widths d_re in mm for resolution, along u and v."""
        return tuple(d + math.log(2) * self.rim for d in self.sides)

    def weight(self, cameras: Cameras) -> Float[Tensor, "m v u"]:
        """Sensitivity of each pixel, counts per line integral, in mm^2: the hole's effective area
        times cos^4(phi) du dv / (4 pi l^2), d_e^2 cos^4(phi) du dv / (16 l^2) for a round one; zero
        outside the acceptance angle.
        """
        start, end = cameras.rays()
        distance = cameras.distance[:, None, None]
        cosine = distance / (end - start).norm(dim=-1)
        area = torch.linalg.cross(cameras.u, cameras.v).norm(dim=-1)[:, None, None]
        weight = self.area_mm2 / (4 * math.pi) * cosine**4 * area / distance**2
        return weight * (cosine >= self.least_cosine)


def _is_size(size: object) -> bool:
    """Whether a value is a number, or a sequence of numbers."""
    numbers = size if isinstance(size, Sequence) and not isinstance(size, str) else (size,)
    return all(isinstance(n, int | float) and not isinstance(n, bool) for n in numbers)
