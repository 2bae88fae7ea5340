"""The Derenzo (hot rod) phantom: six sectors of parallel wells, a test of resolution.

The layout is that of the usual insert: in a sector of 60 degrees wells of diameter d stand on a
triangular lattice of spacing 2 d; row n from the tip has n wells (Derenzo, IEEE Trans. Nucl. Sci.
24 (1977) 544).
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from mvrecon.core.numbers import generator, uniform
from mvrecon.core.quantities import PositiveFloat
from mvrecon.data.scenes.analytic import AnalyticScene
from mvrecon.data.scenes.solids import Phantom, Solids
from mvrecon.geometry.grid import Grid
from mvrecon.geometry.rigid import euler_degrees, euler_rotation, random_in_ball, random_rotation

#: Sectors, of 60 degrees each.
SECTORS = 6


def sector_wells(diameter: float, radius: float) -> Float[Tensor, "n 2"]:
    """Centres (x, y) in mm of the wells of the sector about +x, all of them within the phantom's
    radius.

    A sector of at least two rows starts a tenth of the radius away from the phantom's axis.

    Raises:
        ValueError: not one well fits.
    """
    step = math.sqrt(3) * diameter
    offset = 0.1 * radius
    if (radius - 2 * offset - diameter) / step < 2:
        offset = 0.0
    rows = math.floor((radius - 2 * offset - diameter) / step)
    wells = [
        (offset + step * n, diameter * (2 * i - n + 1))
        for n in range(1, rows + 1)
        for i in range(n)
    ]
    wells = [(x, y) for x, y in wells if math.hypot(x, y) + diameter / 2 <= radius]
    if not wells:
        raise ValueError(
            f"No well of diameter {diameter:g} mm fits into a Derenzo phantom of radius "
            f"{radius:g} mm"
        )
    return torch.tensor(wells, dtype=torch.float64)


def derenzo(
    well_diameters: Sequence[float] = (8, 6, 5, 4, 3, 2),
    radius: float = 40.0,
    height: float = 80.0,
    centre: Sequence[float] = (0.0, 0.0, 0.0),
    euler_degrees: Sequence[float] = (0.0, 0.0, 0.0),
    value: float = 1.0,
    background: float = 0.0,
) -> Phantom:
    """A Derenzo phantom.

    Args:
        well_diameters: of the six sectors in mm, counter-clockwise seen from the phantom's +z, the
            first about its +x.
        radius: of the phantom in mm.
        height: of the wells in mm, from end to end.
        centre: in world mm.
        euler_degrees: (phi, theta, psi) of R_z(phi) R_y(theta) R_z(psi), from the phantom's axes to
            the world's.
        value: in the wells.
        background: between the wells, as a fraction of `value`; above zero it fills the phantom's
            cylinder.

    Raises:
        ValueError: sizes that are not positive, not six diameters, wells that do not fit, a
            background not in [0, 1).
    """
    _check(well_diameters, radius, height, background)
    sectors = [sector_wells(d, radius) for d in well_diameters]
    turns = euler_rotation([(60.0 * k, 0.0, 0.0) for k in range(SECTORS)])[:, :2, :2]
    places = torch.cat([xy @ turn.T for xy, turn in zip(sectors, turns, strict=True)])
    radii = torch.cat(
        [torch.full((len(xy),), d / 2) for xy, d in zip(sectors, well_diameters, strict=True)]
    ).to(places)
    values = torch.full_like(radii, value * (1 - background))
    if background > 0:
        places = torch.cat([places.new_zeros(1, 2), places])
        radii = torch.cat([radii.new_tensor([radius]), radii])
        values = torch.cat([values.new_tensor([value * background]), values])
    centres = torch.nn.functional.pad(places, (0, 1))
    semi_axes = torch.stack([radii, radii, torch.full_like(radii, height / 2)], dim=-1)
    axes = torch.eye(3).expand(len(values), 3, 3)
    upright = Phantom((Solids("cylinder", centres, axes, semi_axes, values),))
    return upright.moved(
        euler_rotation(euler_degrees), torch.tensor(list(centre), dtype=torch.float64)
    )


def _check(
    well_diameters: Sequence[float], radius: float, height: float, background: float
) -> None:
    if len(well_diameters) != SECTORS or not all(d > 0 for d in well_diameters):
        raise ValueError(
            f"A Derenzo phantom needs {SECTORS} positive well diameters in mm, got "
            f"{list(well_diameters)}"
        )
    if not (radius > 0 and height > 0):
        raise ValueError(
            f"A Derenzo phantom needs a positive radius and height in mm, got {radius} and {height}"
        )
    if not 0 <= background < 1:
        raise ValueError(
            f"A Derenzo background must be a fraction in [0, 1) of the value, got {background}"
        )


@dataclass(frozen=True, kw_only=True)
class RandomDerenzo(AnalyticScene):
    """Cases of one Derenzo phantom in a random pose, the rotation uniform on SO(3), the place
    uniform in the field.

    Args:
        well_diameters: of the six sectors, in mm.
        radius_mm: of the phantom.
        height_mm: of its wells, from end to end.
        background: between the wells, as a fraction of `value`.
        fill: least and greatest radius of the ball around the phantom, as fractions of the field's
            radius; the phantom is scaled to it, so that its wells keep their size in voxels on
            every grid. None: the sizes are kept in mm.

    Raises:
        ValueError: as `derenzo`; a fill that is not ascending in (0, 1].
    """

    well_diameters: tuple[PositiveFloat, ...] = (8, 6, 5, 4, 3, 2)
    radius_mm: PositiveFloat = 40.0
    height_mm: PositiveFloat = 48.0
    background: float = 0.0
    fill: tuple[float, float] | None = (0.75, 1.0)
    field: PositiveFloat = 0.46
    unit: str = "activity"
    kind = "derenzo"

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.fill is not None and not (
            len(self.fill) == 2 and 0 < self.fill[0] <= self.fill[1] <= 1
        ):
            raise ValueError(
                f"A Derenzo scene needs a fill (least, greatest) in (0, 1], or none, got "
                f"{self.fill}"
            )
        self._scaled(1.0)

    def _scaled(self, scale: float) -> Phantom:
        return derenzo(
            [d * scale for d in self.well_diameters],
            self.radius_mm * scale,
            self.height_mm * scale,
            value=self.value,
            background=self.background,
        )

    def thinnest(self, grid: Grid) -> float:
        """The least diameter in mm that a well has in any case on `grid`."""
        reach, room = math.hypot(self.radius_mm, self.height_mm / 2), self.radius(grid)
        return min(self.well_diameters) * (
            1.0 if self.fill is None else self.fill[0] * room / reach
        )

    def phantom(self, rng: torch.Generator, grid: Grid) -> Phantom:
        """The phantom in a random pose in the field of `grid`.

        Raises:
            ValueError: the phantom in its true size is larger than the field.
        """
        pose = self._pose(rng, grid)
        return self._scaled(pose.scale).moved(pose.R, pose.t)

    def parameters(self, index: int, seed: int, grid: Grid) -> dict[str, float]:
        """Pose of a case: place of the centre in mm, ZYZ Euler angles in degrees, scale."""
        pose = self._pose(generator(seed, index), grid)
        names = ("x_mm", "y_mm", "z_mm", "phi_degrees", "theta_degrees", "psi_degrees", "scale")
        values = (*pose.t.tolist(), *euler_degrees(pose.R).tolist(), pose.scale)
        return dict(zip(names, values, strict=True))

    def _pose(self, rng: torch.Generator, grid: Grid) -> "_Pose":
        reach, room = math.hypot(self.radius_mm, self.height_mm / 2), self.radius(grid)
        scale = 1.0 if self.fill is None else uniform(rng, *self.fill) * room / reach
        if scale * reach > room * (1 + 1e-9):
            raise ValueError(
                f"A Derenzo phantom needs a field of radius {reach:g} mm, got {room:g} mm; set "
                f"`fill`"
            )
        R = random_rotation(rng)
        return _Pose(R, grid.centre + random_in_ball(rng, room - scale * reach), scale)


class _Pose(NamedTuple):
    """Where a phantom is: X -> R X + t, t in world mm, after its scaling."""

    R: Float[Tensor, "3 3"]
    t: Float[Tensor, "3"]
    scale: float
