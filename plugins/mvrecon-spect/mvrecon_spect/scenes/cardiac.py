"""Cardiac SPECT: a heart with or without a defect in a torso with lungs and liver, and their
attenuation.

Heart axes: z from the base (z = 0) to the apex, x from the left to the right ventricle, with the
origin at the centre of the base. The patient's axes are the world axes: x to the right side, y to
the front, z to the head; the heart is at the origin.
"""

import math
from dataclasses import dataclass
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from mvrecon.core.numbers import generator, uniform
from mvrecon.data.scenes.solids import Phantom, Solids
from mvrecon.geometry.grid import Grid
from mvrecon.geometry.rigid import euler_degrees, euler_rotation, random_in_ball, unit
from mvrecon_spect.scenes.attenuating import AttenuatingScene

#: Semi-axes and centres of the mean patient in mm.
TORSO, TORSO_CENTRE = (145.0, 112.0, 120.0), (40.0, -42.0, 0.0)
RIGHT_LUNG, RIGHT_LUNG_CENTRE = (48.0, 75.0, 80.0), (115.0, -42.0, 37.0)
LEFT_LUNG, LEFT_LUNG_CENTRE = (50.0, 38.0, 80.0), (-20.0, -85.0, 37.0)
LIVER, LIVER_CENTRE = (75.0, 68.0, 43.0), (75.0, -38.0, -102.0)
#: Distance of the left lung's front behind the heart's centre, in mm.
BEHIND = 60.0
#: Direction from the heart's base to its apex: left, anterior, inferior.
LONG_AXIS = (-0.62, 0.62, -0.48)
#: 1/mm at 140.5 keV: water (NIST XCOM), and inflated lung, 0.26 of its density.
WATER, LUNG = 0.01536, 0.0042
#: Ranges: sizes of the heart in mm, size of the torso relative to the mean, uptakes relative to the
#: myocardium.
RADIUS, LENGTH, WALL, SCALE = (28.0, 33.0), (66.0, 78.0), (8.0, 12.0), (0.93, 1.07)
UPTAKES = {"body": (0.05, 0.15), "lung": (0.02, 0.05), "liver": (0.3, 0.8), "right": (0.3, 0.6)}
#: Maximum rotation of the heart about each axis in degrees, and maximum displacement from the
#: origin in mm.
TURN, AWAY = 12.0, 5.0


@dataclass(frozen=True)
class Defect:
    """A part of the left ventricle's wall with reduced uptake.

    Args:
        azimuth_degrees: azimuth of its centre about the long axis, from x towards y.
        width_degrees: angular width about the long axis, below 180.
        low: basal end along the long axis, 0 at the base and 1 at the apex.
        high: apical end.
        contrast: fraction by which the uptake is reduced; 0: no defect.

    Raises:
        ValueError: a width outside (0, 180), ends that are not ascending in [0, 1], or a contrast
            outside [0, 1].
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
        """The half-spaces n.X <= c in heart axes that bound the defect in a ventricle of the given
        length.
        """
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
    """Activity in the parts of the heart, in one unit.

    Args:
        wall: wall of the left ventricle.
        right: wall of the right ventricle.
        blood: both cavities.
        around: surroundings of the heart, to which its solids are added.
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
        length: distance from the base to the outer apex.
        wall: wall thickness of the left ventricle.
        right_width: width of the right ventricle, outward from the left one.
        right_wall: wall thickness of the right ventricle.
        defect: defect in the left ventricle's wall.

    Raises:
        ValueError: non-positive sizes, or walls thicker than the ventricle.
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
        """Half-ellipsoids in heart axes: walls, cavities, and the defect in the left wall."""
        wall, right, blood, around = uptake
        base = torch.tensor([[0.0, 0, -1, 0]], dtype=torch.float64)
        left = base.new_tensor([self.radius, self.radius, self.length]), self.wall
        whole = _shell(*left, (wall - around, blood - wall), base)
        lost = self.defect.contrast * wall
        scar = _shell(*left, (-lost, lost), self.defect.half_spaces(self.length))
        size = base.new_tensor([self.right_width, self.radius, 0.8 * self.length])
        beside = torch.cat([base, base.new_tensor([[-1.0, 0, 0, -self.radius]])])
        levels = right - around, blood - right
        crescent = _shell(size, self.right_wall, levels, beside, self.radius)
        return (whole, crescent) if lost == 0 else (whole, scar, crescent)


def _shell(
    size: Float[Tensor, "3"],
    wall: float,
    values: tuple[float, float],
    cuts: Float[Tensor, "k 4"],
    x: float = 0.0,
) -> Solids:
    """An ellipsoid centred at x and a cavity in it, cut by the same planes."""
    centre, sizes = size.new_tensor([[x, 0, 0]]), torch.stack([size, size - wall])
    both = centre.expand(2, 3), sizes, size.new_tensor(values), cuts.expand(2, -1, -1)
    return Solids.upright("ellipsoid", *both)


class Patient(NamedTuple):
    """One random patient.

    Args:
        heart: sizes of the heart. R: rotation from heart axes to world axes.
        t: centre of the heart's base in world mm.
        scale: scale of the torso along x and y.
        uptake: uptake of body, lung, liver and right ventricle, relative to the left ventricle's
            wall.
    """

    heart: Heart
    R: Float[Tensor, "3 3"]
    t: Float[Tensor, "3"]
    scale: float
    uptake: dict[str, float]


@dataclass(frozen=True, kw_only=True)
class RandomCardiac(AttenuatingScene):
    """Random patients with the heart near the world origin. Size and pose of the heart, uptakes and
    torso are random; some patients have a defect of random position, extent and contrast.

    The heart's wall has the activity `value`; attenuation is that of water and lung. Sizes are
    those of an adult: the grid must contain the torso, 310 x 240 x 240 mm, such as 64 x 52 x 52
    voxels of 5 mm centred at (40, -40, 0), which reach behind no pinhole of `dcspect80`.

    Convention: x to the patient's right, y to the front, z to the head, as in NIfTI.

    Args:
        defects: fraction of cases with a defect.
        contrast: minimum and maximum fraction by which a defect reduces the uptake.
        attenuates: whether the torso attenuates.

    Raises:
        ValueError: a fraction outside [0, 1], or contrasts that are not ascending in [0, 1].
    """

    defects: float = 0.5
    contrast: tuple[float, float] = (0.3, 0.9)
    attenuates: bool = True
    field: float = 0.5
    unit: str = "activity"
    kind = "cardiac"

    def __post_init__(self) -> None:
        super().__post_init__()
        if not 0 <= self.defects <= 1 or not 0 <= self.contrast[0] <= self.contrast[1] <= 1:
            raise ValueError(
                f"Expected a share of defects in [0, 1] and contrasts that ascend in it, got "
                f"{self.defects} and {self.contrast}"
            )

    def phantom(self, rng: torch.Generator, grid: Grid) -> Phantom:
        """The patient's activity.

        Raises:
            ValueError: the grid does not contain the torso.
        """
        patient = self._patient(rng, grid)
        share = {name: self.value * part for name, part in patient.uptake.items()}
        uptake = Uptake(self.value, share["right"], share["body"], share["body"])
        heart = (solids.moved(patient.R, patient.t) for solids in patient.heart.solids(uptake))
        organs = share["body"], share["lung"] - share["body"], share["liver"] - share["body"]
        return Phantom((*_torso(patient.scale, *organs), *heart))

    def matter(self, rng: torch.Generator, grid: Grid) -> Phantom:
        """The patient's attenuation in 1/mm.

        Raises:
            ValueError: the grid does not contain the torso.
        """
        patient = self._patient(rng, grid)
        organs = (WATER, LUNG - WATER, 0.0) if self.attenuates else (0.0, 0.0, 0.0)
        return Phantom(_torso(patient.scale, *organs))

    def parameters(self, index: int, seed: int, grid: Grid) -> dict[str, float]:
        """Pose of the heart (centre of its base in mm, ZYZ Euler angles in degrees), its sizes in
        mm, defect and uptakes of a case.
        """
        patient = self._patient(generator(seed, index), grid)
        places = dict(zip(("x_mm", "y_mm", "z_mm"), patient.t.tolist(), strict=True))
        angles = euler_degrees(patient.R).tolist()
        turns = dict(zip(("phi_degrees", "theta_degrees", "psi_degrees"), angles, strict=True))
        heart, defect = patient.heart, patient.heart.defect
        sizes = {"radius_mm": heart.radius, "length_mm": heart.length, "wall_mm": heart.wall}
        lost = {f"defect_{name}": value for name, value in vars(defect).items()}
        uptakes = {f"uptake_{name}": value for name, value in patient.uptake.items()}
        return {**places, **turns, **sizes, **lost, **uptakes, "torso": patient.scale}

    def _patient(self, rng: torch.Generator, grid: Grid) -> Patient:
        scale = uniform(rng, *SCALE)
        _check_room(grid)
        uptake = {name: uniform(rng, *between) for name, between in UPTAKES.items()}
        ill, loss = uniform(rng, 0, 1) < self.defects, uniform(rng, *self.contrast)
        low, width = uniform(rng, 0.0, 0.6), uniform(rng, 30, 120)
        middle, extent = uniform(rng, 0, 360), uniform(rng, 0.2, 0.4)
        defect = Defect(middle, width, low, low + extent, loss if ill else 0.0)
        sizes = (uniform(rng, *between) for between in (RADIUS, LENGTH, WALL))
        heart = Heart(*sizes, defect=defect)
        R = euler_rotation([uniform(rng, -TURN, TURN) for _ in range(3)], "zyx") @ _upright()
        t = random_in_ball(rng, AWAY) - R[:, 2] * heart.length / 2
        return Patient(heart, R, t, scale, uptake)


def _upright() -> Float[Tensor, "3 3"]:
    """Mean heart axes to patient axes: the right ventricle is on the right, in front."""
    z = unit(torch.tensor(LONG_AXIS, dtype=torch.float64))
    towards = torch.tensor([1.0, 0.5, 0.0], dtype=torch.float64)
    x = unit(towards - z * (z @ towards))
    return torch.stack([x, torch.linalg.cross(z, x), z], dim=-1)


def _torso(scale: float, body: float, lung: float, liver: float) -> tuple[Solids, ...]:
    """An elliptic cylinder of `body`, to which two lungs and a liver are added; everything is
    scaled.
    """
    grow = torch.tensor([scale, scale, 1.0], dtype=torch.float64)
    trunk = _one("cylinder", TORSO_CENTRE, TORSO, body, grow)
    behind, bottom = [[0.0, 1, 0, -BEHIND]], [[0.0, 0, -1, TORSO[2]]]
    return (
        trunk,
        _one("ellipsoid", RIGHT_LUNG_CENTRE, RIGHT_LUNG, lung, grow),
        _one("ellipsoid", LEFT_LUNG_CENTRE, LEFT_LUNG, lung, grow, behind),
        _one("ellipsoid", LIVER_CENTRE, LIVER, liver, grow, bottom),
    )


def _one(
    kind: str,
    centre: tuple[float, float, float],
    semi_axes: tuple[float, float, float],
    value: float,
    grow: Float[Tensor, "3"],
    cuts: list[list[float]] | None = None,
) -> Solids:
    place, size = (grow * torch.tensor([list(v)], dtype=torch.float64) for v in (centre, semi_axes))
    half_spaces = None if cuts is None else torch.tensor([cuts], dtype=torch.float64)
    return Solids.upright(kind, place, size, place.new_tensor([value]), half_spaces)


def _check_room(grid: Grid) -> None:
    """Check that a grid contains the largest torso.

    Raises:
        ValueError: the box of the grid is smaller; the message suggests a sufficient one.
    """
    grow = torch.tensor([SCALE[1], SCALE[1], 1.0], dtype=torch.float64)
    middle, half = grow * torch.tensor(TORSO_CENTRE).double(), grow * torch.tensor(TORSO).double()
    ends = grid.to_index(torch.stack([middle - half, middle + half]))
    last = torch.tensor(grid.shape[::-1]) - 0.5
    if (ends.amin(dim=0) < -0.5).any() or (ends.amax(dim=0) > last).any():
        edges = [math.ceil(2 * x) for x in half.tolist()]
        raise ValueError(
            f"Expected a grid that holds a torso of {edges} mm about "
            f"{[round(x, 1) for x in middle.tolist()]}, such as grid.size=[64,64,64] "
            f"grid.spacing=5 grid.centre=[40,-40,0], got size {grid.size}, spacing "
            f"{grid.spacing}, centre {[round(x, 1) for x in grid.centre.tolist()]}"
        )
