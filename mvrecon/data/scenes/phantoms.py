"""Phantoms of solids and their scenes: Derenzo, random ellipsoids, Shepp-Logan."""

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
    """Centres (x, y) in mm of the rods of the sector about +x, inside the phantom's radius.

    A sector of at least two rows starts a tenth of the radius away from the phantom's axis.

    Raises:
        ValueError: no rod fits.
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
    """A Derenzo (hot rod) phantom: six sectors of parallel rods, a test of resolution.

    The usual insert: in a sector of 60 degrees rods of diameter d form a triangular lattice of
    spacing 2 d; row n from the tip has n rods (Derenzo, IEEE Trans. Nucl. Sci. 24 (1977) 544).

    Args:
        well_diameters: rod diameter of each of the six sectors in mm, counter-clockwise seen from
            the phantom's +z, the first about its +x.
        radius: radius of the phantom, in mm.
        height: length of the rods, in mm.
        centre: centre of the phantom, world mm.
        euler_degrees: (phi, theta, psi) of R_z(phi) R_y(theta) R_z(psi), from the phantom's axes to
            the world's.
        value: value in the rods.
        background: value between the rods, as a fraction of `value`; above zero it fills the
            phantom's cylinder.

    Raises:
        ValueError: sizes that are not positive, not six diameters, rods that do not fit, a
            background outside [0, 1).
    """
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
    upright = Phantom((Solids.upright("cylinder", centres, semi_axes, values),))
    return upright.moved(
        euler_rotation(euler_degrees), torch.tensor(list(centre), dtype=torch.float64)
    )


@dataclass(frozen=True, kw_only=True)
class RandomDerenzo(AnalyticScene):
    """Cases of one Derenzo phantom in a random pose, the rotation uniform on SO(3), the position
    uniform in the field.

    Args:
        well_diameters: rod diameter of each of the six sectors, in mm.
        radius_mm: radius of the phantom, in mm.
        height_mm: length of its rods, in mm.
        background: value between the rods, as a fraction of `value`.
        fill: least and greatest radius of the ball around the phantom, as fractions of the field's
            radius; the phantom is scaled to it, so that rods have the same size in voxels on every
            grid. None: sizes stay in mm.

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

    def phantom(self, rng: torch.Generator, grid: Grid) -> Phantom:
        """The phantom in a random pose in the field of `grid`.

        Raises:
            ValueError: the unscaled phantom is larger than the field.
        """
        pose = self._pose(rng, grid)
        return self._scaled(pose.scale).moved(pose.R, pose.t)

    def parameters(self, index: int, seed: int, grid: Grid) -> dict[str, float]:
        """Pose of a case: position of the centre in mm, ZYZ Euler angles in degrees, scale."""
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
    """Pose of a phantom: X -> R X + t, t in world mm, after its scaling."""

    R: Float[Tensor, "3 3"]
    t: Float[Tensor, "3"]
    scale: float


@dataclass(frozen=True, kw_only=True)
class RandomEllipsoids(AnalyticScene):
    """Cases of a random body that contains random ellipsoids; values are between 0 and `value`.

    Args:
        count: least and greatest number of ellipsoids in the body.
        sizes: their least and greatest semi-axis, as fractions of the field's radius.

    Raises:
        ValueError: counts or sizes that are negative or not ascending.
    """

    count: tuple[int, int] = (3, 12)
    sizes: tuple[PositiveFloat, PositiveFloat] = (0.1, 0.45)
    kind = "ellipsoids"

    def __post_init__(self) -> None:
        super().__post_init__()
        if len(self.count) != 2 or not 0 <= self.count[0] <= self.count[1]:
            raise ValueError(
                f"Ellipsoids need a count (least, greatest) of at least 0, got {tuple(self.count)}"
            )
        if len(self.sizes) != 2 or not 0 < self.sizes[0] <= self.sizes[1]:
            raise ValueError(
                f"Ellipsoids need sizes (least, greatest) above 0, got {tuple(self.sizes)}"
            )

    def phantom(self, rng: torch.Generator, grid: Grid) -> Phantom:
        """A random phantom in the field of `grid`; the first solid is the body, which contains the
        others.
        """
        radius = self.radius(grid)
        body_axes = torch.tensor(
            [uniform(rng, 0.6, 0.95) * radius for _ in range(3)], dtype=torch.float64
        )
        body_centre = grid.centre + random_in_ball(rng, radius - body_axes.max().item())
        body_rotation = random_rotation(rng)
        count = int(torch.randint(self.count[0], self.count[1] + 1, (), generator=rng))
        places = torch.stack([body_centre] + [torch.zeros(3).to(body_centre)] * count)
        axes = torch.stack([body_axes] * (count + 1))
        for n in range(1, count + 1):
            p = random_in_ball(rng, 0.85)
            room = (1 - p.norm().item()) * body_axes.min().item()  # fits into the body
            places[n] = body_centre + body_rotation @ (body_axes * p)
            for i in range(3):
                axes[n, i] = min(room, uniform(rng, *self.sizes) * radius)
        rotations = torch.cat([body_rotation[None], random_rotation(rng, count)])
        return Phantom(
            (Solids("ellipsoid", places, rotations, axes, self.value * _values(rng, places, axes)),)
        )


def _values(
    rng: torch.Generator, places: Float[Tensor, "n 3"], axes: Float[Tensor, "n 3"]
) -> Float[Tensor, " n"]:
    """Random values, the first positive, whose sums over overlapping ellipsoids stay between 0 and
    1.

    For each ellipsoid all earlier ones that may overlap it (by bounding spheres) are assumed to
    overlap together. Its value is part of their remaining range, so sums are bounded everywhere.
    """
    reach = axes.amax(dim=1)
    meet = torch.cdist(places, places) < reach + reach[:, None]
    meet[0], meet[:, 0] = True, True
    values = torch.zeros(len(places), dtype=torch.float64)
    values[0] = uniform(rng, 0.2, 0.4)
    for n in range(1, len(values)):
        earlier = values[:n][meet[n, :n]]
        # neighbours of n that do not overlap each other may leave no range together
        below = (earlier[0] + earlier.clamp(max=0).sum()).clamp(min=0)
        above = (1 - earlier.clamp(min=0).sum()).clamp(min=0)
        up = uniform(rng, 0, 1) < 0.6
        values[n] = uniform(rng, 0.3, 1.0) * above if up else -uniform(rng, 0.3, 0.9) * below
    return values


#: Yu, Ye and Wang, "Katsevich-type algorithms for variable radius spiral cone-beam CT", Proc. SPIE
#: 5535 (2004) 550: the head of Kak and Slaney, Principles of Computerized Tomographic Imaging
#: (1988), table 3.1, in 3-D, with visible contrasts. Columns: value, semi-axes a b c, centre x y z,
#: rotation about z in degrees; the head is in [-1, 1].
HEAD_TABLE = (
    (1.0, 0.69, 0.92, 0.9, 0.0, 0.0, 0.0, 0.0),
    (-0.8, 0.6624, 0.874, 0.88, 0.0, 0.0, 0.0, 0.0),
    (-0.2, 0.41, 0.16, 0.21, -0.22, 0.0, -0.25, 108.0),
    (-0.2, 0.31, 0.11, 0.22, 0.22, 0.0, -0.25, 72.0),
    (0.2, 0.21, 0.25, 0.5, 0.0, 0.35, -0.25, 0.0),
    (0.2, 0.046, 0.046, 0.046, 0.0, 0.1, -0.25, 0.0),
    (0.1, 0.046, 0.023, 0.02, -0.08, -0.65, -0.25, 0.0),
    (0.1, 0.046, 0.023, 0.02, 0.06, -0.65, -0.25, 90.0),
    (0.2, 0.056, 0.04, 0.1, 0.06, -0.105, 0.625, 90.0),
    (-0.2, 0.056, 0.056, 0.1, 0.0, 0.1, 0.625, 0.0),
)


def shepp_logan(
    half_edge: float = 1.0, centre: Sequence[float] = (0.0, 0.0, 0.0), value: float = 1.0
) -> Phantom:
    """The 3-D Shepp-Logan phantom in the cube of a half edge in mm about a centre; `value` is that
    of the skull.

    Raises:
        ValueError: a half edge that is not positive.
    """
    table = torch.tensor(HEAD_TABLE, dtype=torch.float64)
    turns = torch.nn.functional.pad(table[:, 7:], (0, 2))
    semi_axes, places = table[:, 1:4] * half_edge, table[:, 4:7] * half_edge
    places = places + torch.tensor(list(centre), dtype=torch.float64)
    return Phantom(
        (Solids("ellipsoid", places, euler_rotation(turns), semi_axes, table[:, 0] * value),)
    )


@dataclass(frozen=True, kw_only=True)
class SheppLogan(AnalyticScene):
    """One case: the 3-D Shepp-Logan phantom, with the field's radius as half edge of its cube."""

    field: float = 0.5
    kind = "shepp_logan"
    length = 1

    def phantom(self, rng: torch.Generator, grid: Grid) -> Phantom:
        """The phantom in the field of `grid`, without randomness."""
        return shepp_logan(self.radius(grid), grid.centre.tolist(), self.value)
