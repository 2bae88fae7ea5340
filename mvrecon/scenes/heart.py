"""The heart that a cardiac SPECT camera images: a left ventricle that ends in a plane at its base,
a defect in its wall, a right ventricle beside it.

The heart's own axes: z from the base, z = 0, to the apex; x from the left ventricle to the right
one; its origin is in the middle of the base.
"""

import math
from dataclasses import dataclass
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from mvrecon.scenes.solids import Solids


@dataclass(frozen=True)
class Defect:
    """A part of the left ventricle's wall with less uptake.

    Args:
        azimuth_degrees: of its middle about the long axis, from x towards y.
        width_degrees: about the long axis, below 180.
        low: its basal end along the long axis, 0 at the base and 1 at the apex.
        high: its apical end.
        contrast: the share of the wall's uptake that is lost; 0: no defect.

    Raises:
        ValueError: a width not in (0, 180), ends that do not ascend in [0, 1], a contrast not in
            [0, 1].
    """

    azimuth_degrees: float = 0.0
    width_degrees: float = 60.0
    low: float = 0.3
    high: float = 0.7
    contrast: float = 0.0

    def __post_init__(self) -> None:
        wide, along = 0 < self.width_degrees < 180, 0 <= self.low < self.high <= 1
        if not (wide and along and 0 <= self.contrast <= 1):
            raise ValueError(
                f"Expected a defect of 0 to 180 degrees, with ends that ascend in [0, 1] and a "
                f"contrast in [0, 1], got {self}"
            )

    def half_spaces(self, length: float) -> Float[Tensor, "4 4"]:
        """The half-spaces n.X <= c, in the heart's axes, that hold it in a ventricle so long."""
        first, last = (
            math.radians(self.azimuth_degrees + sign * self.width_degrees / 2) for sign in (-1, 1)
        )
        return torch.tensor(
            [
                [math.sin(first), -math.cos(first), 0, 0],
                [-math.sin(last), math.cos(last), 0, 0],
                [0, 0, -1, -self.low * length],
                [0, 0, 1, self.high * length],
            ],
            dtype=torch.float64,
        )


class Uptake(NamedTuple):
    """Activity in the parts of the heart, of one unit.

    Args:
        wall: of the left ventricle.
        right: the wall of the right ventricle.
        blood: in both cavities.
        around: of what surrounds the heart, to which its solids add.
    """

    wall: float = 1.0
    right: float = 0.5
    blood: float = 0.0
    around: float = 0.0


@dataclass(frozen=True)
class Heart:
    """Sizes of a heart in mm.

    Args:
        radius: outer radius of the left ventricle at its base.
        length: from the base to the outer apex.
        wall: thickness of the left ventricle's wall.
        right_width: of the right ventricle, from the left one outwards.
        right_wall: thickness of its wall.
        defect: in the left ventricle's wall.

    Raises:
        ValueError: sizes that are not positive, or walls thicker than what they are around.
    """

    radius: float = 31.0
    length: float = 73.0
    wall: float = 10.0
    right_width: float = 20.0
    right_wall: float = 4.0
    defect: Defect = Defect()

    def __post_init__(self) -> None:
        left, right = min(self.radius, self.length), min(self.right_width, self.radius)
        if not (0 < self.wall < left < math.inf and 0 < self.right_wall < right):
            raise ValueError(f"Expected positive walls below the ventricles' radii, got {self}")

    def solids(self, uptake: Uptake) -> tuple[Solids, ...]:
        """Half ellipsoids in the heart's axes: walls, cavities, and the defect in the left wall."""
        wall, right, blood, around = uptake
        left = [_ellipsoid(self.radius - t, self.length - t) for t in (0.0, self.wall)]
        base = torch.tensor([[0.0, 0, -1, 0]], dtype=torch.float64)
        values = left[0].new_tensor([wall - around, blood - wall])
        whole = _half(left, values, base)
        lost = self.defect.contrast * wall
        scar = _half(left, values.new_tensor([-lost, lost]), self._defect())
        beside = torch.cat([base, base.new_tensor([[-1.0, 0, 0, -self.radius]])])
        size = base.new_tensor([self.right_width, self.radius, 0.8 * self.length])
        outer = [size, size - self.right_wall]
        crescent = _half(outer, values.new_tensor([right - around, blood - right]), beside)
        crescent = _shifted(crescent, self.radius)
        return (whole, crescent) if lost == 0 else (whole, scar, crescent)

    def _defect(self) -> Float[Tensor, "4 4"]:
        return self.defect.half_spaces(self.length)


def _ellipsoid(radius: float, length: float) -> Float[Tensor, "3"]:
    return torch.tensor([radius, radius, length], dtype=torch.float64)


def _half(
    sizes: list[Float[Tensor, "3"]], values: Float[Tensor, " n"], cuts: Float[Tensor, "k 4"]
) -> Solids:
    """Ellipsoids about the origin, all cut by the same planes."""
    n = len(sizes)
    places, turns = torch.zeros(n, 3), torch.eye(3).expand(n, 3, 3)
    return Solids("ellipsoid", places, turns, torch.stack(sizes), values, cuts.expand(n, -1, -1))


def _shifted(solids: Solids, x: float) -> Solids:
    """Ellipsoids moved along x, their planes left where they are."""
    moved = torch.zeros(len(solids.values), 3, dtype=torch.float64)
    moved[:, 0] = x
    return Solids(
        solids.kind, moved, solids.rotations, solids.semi_axes, solids.values, solids.cuts
    )
