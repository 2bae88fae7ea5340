"""Unknown errors of views: their options, and their values for a case."""

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields, replace
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from mvrecon.geometry.cameras.camera import Cameras
from mvrecon.geometry.cameras.random_rigs import Misalignment, misaligned
from mvrecon.geometry.grid import Grid, voxel_centres


@dataclass(frozen=True, eq=False, kw_only=True)
class RigErrors:
    """The errors of the views of one case.

    Args:
        shift_px: shift of each detector along its columns' and its rows' direction (u, v), in
            pixels.
        gain: factor of each view; 0 where the view is lost.
        tilt_deg: rotations of each detector about its centre, as those of `Misalignment`.
        motion_mm: displacement of the object in each view, along x, y and z.
        saturated: values are clipped to this share of the view's greatest value.
        truncated: share of columns that read zero, the last ones; if negative, the first ones.
        rod: shadow of a round rod in the beam: its greatest value as a share of the view's, the
            angle in degrees from the columns' direction to the normal of its axis, the distance of
            the axis from the detector's centre and half of the width, both in shares of the row.
        scatter: scatter-to-primary ratio beside that of the acquisition.
        columns: -1 for a dead column, which reads zero, 1 for a hot one, which reads the greatest
            value of the view.
        breathing_mm: amplitude of the deformed object that the view sees; 0: at rest.
    """

    shift_px: Float[Tensor, "m 2"]
    gain: Float[Tensor, " m"]
    tilt_deg: Float[Tensor, "m 3"]
    motion_mm: Float[Tensor, "m 3"]
    saturated: Float[Tensor, " m"]
    truncated: Float[Tensor, " m"]
    rod: Float[Tensor, "m 4"]
    scatter: Float[Tensor, " m"]
    columns: Float[Tensor, "m u"]
    breathing_mm: Float[Tensor, " m"]

    def record(self) -> dict[str, Tensor]:
        """Every error by its name, float32, and which views are faulty in any way ("wrong")."""
        errors = {field.name: getattr(self, field.name) for field in fields(self)}
        off = torch.column_stack([*{**errors, "gain": self.gain - 1}.values()])
        return {name: value.float() for name, value in errors.items()} | {
            "wrong": (off != 0).any(dim=1)
        }

    @classmethod
    def of(cls, batch: Mapping[str, Any], number: int = 0) -> "RigErrors":
        """The errors of a case of a batch, which has them by name as `record` returns them."""
        return cls(**{field.name: batch[field.name][number] for field in fields(cls)})

    def image_shift(
        self, cameras: Cameras, volume: Float[Tensor, "d h w"], grid: Grid
    ) -> Float[Tensor, "m 2"]:
        """How far shift, tilt and motion together move the image of an object, as a shift of the
        detector (u, v) in pixels: the mean over the object's voxels, weighted by their values.

        Args:
            cameras: the rig as stated.
            volume: the object, zero or more.
            grid: grid of the volume.
        """
        points = voxel_centres(grid).reshape(-1, 3)
        stated, true = (
            rig.project(points.to(rig.source))[..., :2] for rig in (cameras, self.rig(cameras))
        )
        moved = (stated - true).double()
        weights = volume.flatten().to(moved)
        return torch.einsum("mnk,n->mk", moved, weights) / weights.sum()

    def rig(self, cameras: Cameras) -> Cameras:
        """The true cameras, relative to the object."""
        moved = cameras.shifted(self.shift_px.to(cameras.source))
        if self.tilt_deg.any():
            turns = self.tilt_deg.to(moved.source)
            still = Misalignment.none(len(cameras))
            moved = misaligned(moved, still._replace(tilt_degrees=turns))
        # motion of the object is opposite motion of the cameras
        step = -self.motion_mm.to(moved.source)
        return replace(moved, source=moved.source + step, origin=moved.origin + step)

    def views(self, views: Float[Tensor, "1 m v u"]) -> Float[Tensor, "1 m v u"]:
        """Apply all errors but scatter and those of `read` to ideal views of the true rig, in the
        views' unit.
        """
        if self.rod.any():
            views = views + views.amax(dim=(2, 3), keepdim=True) * self._shadows(views)
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

    def read(self, views: Float[Tensor, "1 m v u"]) -> Float[Tensor, "1 m v u"]:
        """Replace the values of dead and hot columns of measured views."""
        columns = self.columns[:, None].to(views)
        views = views * (columns >= 0)
        return torch.where(columns > 0, views.amax(dim=(2, 3), keepdim=True), views)

    def _shadows(self, views: Float[Tensor, "1 m v u"]) -> Float[Tensor, "m v u"]:
        """Chords through the rods at the pixels' centres, times their shares."""
        share, angle, offset, half = self.rod.to(views).T[..., None, None]
        v, u = (
            (torch.arange(n, dtype=views.dtype) - (n - 1) / 2) / views.shape[3]
            for n in views.shape[2:]
        )
        angle = angle.deg2rad()
        apart = u * angle.cos() + v[:, None] * angle.sin() - offset
        return share * (1 - (apart / half.clamp_min(1e-9)).square()).clamp_min(0).sqrt()


def _each(number: Float[Tensor, " m"], views: Float[Tensor, "1 m v u"]) -> Tensor:
    """One number for each view, shaped to multiply views."""
    return number.to(views)[:, None, None]


#: Options that count views, with their least values.
MIN_VIEW_COUNTS = {"views": 1, "lost": 0}
#: Upper bounds of options; others must be finite.
UPPER_BOUNDS = {"gain": 1.0, "tilt_deg": 45.0, "saturated": 1.0, "truncated": 1.0, "dead": 1.0}
#: Phases of breathing, the first at rest.
PHASES = 4
#: Least part of `rod`, `scatter` and `breathing_mm` that is drawn.
LEAST_PART = 1 / 8
#: Greatest distance of a rod's axis from the centre, and its least and greatest half width, in
#: shares of the row.
ROD_OFFSET, ROD_HALF_WIDTHS = 0.3, (0.015, 0.05)


@dataclass(frozen=True, kw_only=True)
class Disturbance:
    """Errors of each case, unknown to the reconstruction: some views' detectors are shifted
    (pixels) and tilted (degrees), the object moved (mm), values scaled, clipped, cut off or lost;
    or views are inconsistent in some of their pixels, by a rod, scatter, dead columns, or because
    the object breathes.

    Args:
        views: number of views, drawn for each case, with all errors but `lost`; `rod`, `scatter`,
            `dead` and `breathing_mm` are each drawn for as many views of their own.
        shift_px: largest shift of the detector along columns and rows, in pixels; uniform in
            +-this.
        gain: largest relative error of the views' values, which are multiplied by 1 + a number
            uniform in +-this.
        tilt_deg: largest rotation of the detector about its centre, in degrees: about its columns'
            and rows' directions and its normal, each uniform in +-this.
        motion_mm: largest displacement of the object during the view, in mm: along x, y and z, each
            uniform in +-this.
        saturated: share of a view's greatest value at which an overexposed detector clips.
        truncated: share of a detector's columns, at its left or right end, that read zero.
        rod: greatest value of the shadow of a rod in the beam, such as a cable or metal, as a share
            of the view's; uniform from an eighth of this to this. Angle, place and width, 3 to 10 %
            of a row, differ from view to view.
        scatter: scatter-to-primary ratio, beside that of the acquisition; uniform from an eighth of
            this to this.
        dead: share of a detector's columns, at random places, that read zero or, with probability
            1/2 each, the view's greatest value.
        breathing_mm: the object breathes: each drawn view sees one of three phases, a third, two
            thirds or all of an amplitude of the case, uniform from an eighth of this to this; all
            other views, and the true volume, are at rest. See `mvrecon.data.acquisition.breathing`.
        lost: number of views, drawn independently, that read zero everywhere.
        probability: probability with which each of the drawn views is faulty, or lost; 1: all are.

    Raises:
        TypeError: an option that is no number.
        ValueError: numbers below 0, not finite or too large; numbers of views that are not whole.
    """

    views: int = 1
    shift_px: float = 0.0
    gain: float = 0.0
    tilt_deg: float = 0.0
    motion_mm: float = 0.0
    saturated: float = 0.0
    truncated: float = 0.0
    rod: float = 0.0
    scatter: float = 0.0
    dead: float = 0.0
    breathing_mm: float = 0.0
    lost: int = 0
    probability: float = 1.0

    def __post_init__(self) -> None:
        for name, value in asdict(self).items():
            if not isinstance(value, int | float) or isinstance(value, bool):
                raise TypeError(f"Expected disturbed.{name} as a number, got {value!r}")
            if name in MIN_VIEW_COUNTS:
                expected = f"a whole number of at least {MIN_VIEW_COUNTS[name]}"
                fits = MIN_VIEW_COUNTS[name] <= value < math.inf and value == int(value)
            elif name == "probability":
                expected, fits = "a number from 0 to 1", 0 <= value <= 1
            elif name in UPPER_BOUNDS:
                expected = f"a number from 0 to below {UPPER_BOUNDS[name]:g}"
                fits = 0 <= value < UPPER_BOUNDS[name]
            else:
                expected, fits = "a number of at least 0", 0 <= value < math.inf
            if not fits:
                raise ValueError(f"Expected disturbed.{name} as {expected}, got {value}")


def rig_errors(disturbance: Disturbance, cameras: Any, rng: torch.Generator) -> RigErrors:
    """Draw the errors of one case: shifts in pixels, tilts in degrees, motions in mm, gains and
    shares without a unit.

    Raises:
        ValueError: more views than cameras, or explicit rays, which have no detector.
    """
    if not isinstance(cameras, Cameras):
        raise ValueError(f"Expected cameras to disturb, got {type(cameras).__name__}")
    m = len(cameras)
    for name in MIN_VIEW_COUNTS:
        if (count := getattr(disturbance, name)) > m:
            raise ValueError(
                f"Expected disturbed.{name} of at most the rig's {m} cameras, got {count}"
            )
    chosen = _drawn(m, disturbance.views, rng)
    # shifts and gains first, so that cases of older runs stay the same
    offset, gain = _uniform(m, 3, rng).split((2, 1), dim=1)
    tilt, motion, side = _uniform(m, 7, rng).split((3, 3, 1), dim=1)
    lost = _drawn(m, disturbance.lost, rng)
    wrong, missing = (torch.rand(2, m, 1, generator=rng) < disturbance.probability).double()
    chosen, lost = chosen * wrong, lost * missing
    in_beam, scattering, failing = (_faulty(m, disturbance, rng) for _ in range(3))
    rod, scatter = _uniform(m, 4, rng), _uniform(m, 1, rng)
    least, most = ROD_HALF_WIDTHS
    rod = torch.stack(
        [
            disturbance.rod * _part(rod[:, 0]),
            90 * rod[:, 1],
            ROD_OFFSET * rod[:, 2],
            least + (most - least) * (1 + rod[:, 3]) / 2,
        ],
        dim=1,
    )
    count = round(disturbance.dead * cameras.shape[1])
    place = torch.rand(m, cameras.shape[1], generator=rng).argsort(dim=1).argsort(dim=1)
    columns = (place < count) * _uniform(m, cameras.shape[1], rng).sign()
    breathing = _faulty(m, disturbance, rng)
    phase = torch.randint(1, PHASES, (m, 1), generator=rng).double() / (PHASES - 1)
    amplitude = disturbance.breathing_mm * _part(_uniform(1, 1, rng))
    return RigErrors(
        shift_px=disturbance.shift_px * chosen * offset,
        gain=((1 + disturbance.gain * chosen * gain) * (1 - lost))[:, 0],
        tilt_deg=disturbance.tilt_deg * chosen * tilt,
        motion_mm=disturbance.motion_mm * chosen * motion,
        saturated=(disturbance.saturated * chosen)[:, 0],
        truncated=(disturbance.truncated * chosen * torch.where(side < 0, -1, 1))[:, 0],
        rod=rod * in_beam * (disturbance.rod > 0),
        scatter=(disturbance.scatter * scattering * _part(scatter))[:, 0],
        columns=columns * failing,
        breathing_mm=(amplitude * phase * breathing)[:, 0],
    )


def _part(uniform: Float[Tensor, "*n"]) -> Float[Tensor, "*n"]:
    """From numbers uniform in +-1 to numbers uniform from `LEAST_PART` to 1."""
    return LEAST_PART + (1 - LEAST_PART) * (1 + uniform) / 2


def _faulty(m: int, disturbance: Disturbance, rng: torch.Generator) -> Float[Tensor, "m 1"]:
    """1 for the views that are faulty in one way, 0 for the others."""
    chosen = _drawn(m, disturbance.views, rng)
    return chosen * (torch.rand(m, 1, generator=rng, dtype=torch.float64) < disturbance.probability)


def _drawn(m: int, count: float, rng: torch.Generator) -> Float[Tensor, "m 1"]:
    """1 for a random selection of so many of m cameras, 0 for the others."""
    chosen = torch.zeros(m, 1, dtype=torch.float64)
    chosen[torch.randperm(m, generator=rng)[: int(count)]] = 1.0
    return chosen


def _uniform(m: int, count: int, rng: torch.Generator) -> Float[Tensor, "m count"]:
    return 2 * torch.rand(m, count, generator=rng, dtype=torch.float64) - 1
