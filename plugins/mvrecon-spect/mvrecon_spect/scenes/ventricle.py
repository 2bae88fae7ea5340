"""The left ventricle of the heart as imaged by cardiac SPECT: a myocardial shell around a cavity.

Both surfaces are concentric ellipsoids, closed at the base, so that integrals are exact; a real
ventricle ends in a plane there.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import torch

from mvrecon.core.quantities import PositiveFloat
from mvrecon.data.scenes.analytic import AnalyticScene
from mvrecon.data.scenes.solids import Phantom, Solids
from mvrecon.geometry.grid import Grid
from mvrecon.geometry.rigid import euler_rotation, random_in_ball, random_rotation


def ventricle(
    semi_axes: Sequence[float] = (32.0, 32.0, 45.0),
    wall: float = 10.0,
    centre: Sequence[float] = (0.0, 0.0, 0.0),
    euler_degrees: Sequence[float] = (0.0, 0.0, 0.0),
    value: float = 1.0,
    blood: float = 0.0,
) -> Phantom:
    """A closed ellipsoidal shell: an ellipsoid minus a smaller concentric one.

    Args:
        semi_axes: semi-axes of the outer surface in mm; the last is the long axis of the ventricle.
        wall: wall thickness in mm at the ends of the axes.
        centre: centre in world mm.
        euler_degrees: (phi, theta, psi) of R_z(phi) R_y(theta) R_z(psi), from the ventricle's axes
            to world axes.
        value: value in the wall.
        blood: value in the cavity, as a fraction of `value`.

    Raises:
        ValueError: not three semi-axes larger than the wall, a non-positive wall, or blood outside
            [0, 1).
    """
    outer = torch.tensor(list(semi_axes), dtype=torch.float64)
    if not (outer.shape == (3,) and outer.isfinite().all() and 0 < wall < outer.min()):
        raise ValueError(
            f"A ventricle needs three semi-axes above a positive wall, got {list(semi_axes)} and "
            f"{wall}"
        )
    if not 0 <= blood < 1:
        raise ValueError(
            f"A ventricle's blood must be a fraction in [0, 1) of the value, got {blood}"
        )
    surfaces = torch.stack([outer, outer - wall])
    values = outer.new_tensor([value, -value * (1 - blood)])
    shell = Solids.upright("ellipsoid", torch.zeros(2, 3), surfaces, values)
    return Phantom((shell,)).moved(
        euler_rotation(euler_degrees), torch.tensor(list(centre), dtype=torch.float64)
    )


@dataclass(frozen=True, kw_only=True)
class RandomVentricle(AnalyticScene):
    """Cases of one ventricle of realistic size in a random pose: the rotation is uniform on SO(3),
    the position inside the field of view.

    Args:
        semi_axes_mm: semi-axes of the outer surface.
        wall_mm: wall thickness at the ends of the axes.
        blood: value in the cavity, as a fraction of `value`.

    Raises:
        ValueError: see `ventricle`.
    """

    semi_axes_mm: tuple[float, float, float] = (32.0, 32.0, 45.0)
    wall_mm: PositiveFloat = 10.0
    blood: float = 0.0
    field: PositiveFloat = 0.46
    unit: str = "activity"
    kind = "ventricle"

    def __post_init__(self) -> None:
        super().__post_init__()
        self._upright()

    def _upright(self) -> Phantom:
        return ventricle(self.semi_axes_mm, self.wall_mm, value=self.value, blood=self.blood)

    def phantom(self, rng: torch.Generator, grid: Grid) -> Phantom:
        """The ventricle in a random pose within the field of view of `grid`.

        Raises:
            ValueError: the ventricle is larger than the field of view.
        """
        reach, room = max(self.semi_axes_mm), self.radius(grid)
        if reach > room:
            raise ValueError(
                f"A ventricle of semi-axis {reach:g} mm needs a field of that radius, got "
                f"{room:g} mm"
            )
        return self._upright().moved(
            random_rotation(rng), grid.centre + random_in_ball(rng, room - reach)
        )
