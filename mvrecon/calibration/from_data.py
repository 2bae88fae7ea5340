"""Calibration from the measured views alone: the misalignment that makes them consistent with one
volume.

A rig that is wrong leaves a residual that no volume explains. What all views share (a detector's
offset, the tilt of the axis) is fitted by Gauss-Newton steps on the residual of the whole
reconstruction, the volume being computed anew for every try (variable projection: Golub & Pereyra,
SIAM J. Numer. Anal. 10, 1973); shifts of single views by matching each with the re-projection of
the current volume (alignment by re-projection: Dengler, Ultramicroscopy 30, 1989).
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from mvrecon.cameras.camera import Cameras
from mvrecon.cameras.field import isocentre
from mvrecon.cameras.misalignment import Misalignment, misaligned
from mvrecon.cameras.views import check_finite
from mvrecon.projectors.operator import LinearOperator
from mvrecon.reconstruct.iterative import sirt, sirt_weights
from mvrecon.registry import hint

OperatorOf = Callable[[Cameras], LinearOperator]

#: What all views may share: a field of `Misalignment` and its column.
SHARED = {
    "offset_u": ("offset_px", 0),
    "offset_v": ("offset_px", 1),
    "slant": ("tilt_degrees", 0),
    "swivel": ("tilt_degrees", 1),
    "tilt": ("tilt_degrees", 2),
}
#: Pixels (degrees) by which a difference quotient steps, and the longest step of a round.
STEP, LONGEST = 0.1, 3.0


class Estimate(NamedTuple):
    """A calibrated rig.

    Args:
        cameras: the rig.
        misalignment: what was wrong with the rig that was given, in pixels, degrees and mm.
        residual: ||y - A x|| / ||y|| of every round's reconstruction, the first being that of the
            rig that was given.
    """

    cameras: Cameras
    misalignment: Misalignment
    residual: list[float]


@torch.no_grad()
def shared_misalignment(
    operator_of: OperatorOf,
    cameras: Cameras,
    views: Float[Tensor, "1 1 m v u"],
    free: Sequence[str] = ("offset_u", "tilt"),
    iterations: int = 30,
    rounds: int = 5,
) -> Estimate:
    """Detector offset (pixels) and axis tilt (degrees) that all views share, from the measured
    views alone.

    A tilt needs a grid fine enough for the object: errors of sharp edges on a coarse one outweigh
    it (experiments/08_calibration).

    Args:
        operator_of: the operator of a rig, such as `partial(Drr, grid)`; the grid must hold the
            whole object.
        cameras: the rig as it should be.
        views: measured integrals.
        free: what is fitted: "offset_u", "offset_v" (pixels), "tilt" (about the beam), "slant"
            (about u), "swivel" (about v; degrees). Along the axis of a circle an offset_v is nearly
            a shift of the object.
        iterations: of SIRT with momentum for every volume.
        rounds: of Gauss-Newton; each computes 1 + len(free) volumes.

    Raises:
        ValueError: an unknown name, or views that are not finite.
    """
    check_finite(views)
    for name in free:
        if name not in SHARED:
            raise ValueError(f"Unknown misalignment {name!r}{hint(name, SHARED)}")
    theta, history = torch.zeros(len(free), dtype=torch.float64), []
    steps = STEP * torch.eye(len(free), dtype=torch.float64)

    def residual(values: Tensor) -> Tensor:
        A = operator_of(misaligned(cameras, _shared(free, values)))
        return (A(_volume(A, views, iterations)) - views).flatten().double()

    for _ in range(rounds):
        r = residual(theta)
        history.append((r.norm() / views.double().norm()).item())
        J = torch.stack([(residual(theta + step) - r) / STEP for step in steps], dim=1)
        change = torch.linalg.lstsq(J, -r[:, None]).solution[:, 0]
        theta = theta + change.clamp(-LONGEST, LONGEST)
    by = _shared(free, theta)
    return Estimate(misaligned(cameras, by), by, history)


@torch.no_grad()
def view_shifts(
    operator_of: OperatorOf,
    cameras: Cameras,
    views: Float[Tensor, "1 1 m v u"],
    iterations: int = 10,
    rounds: int = 20,
) -> Estimate:
    """Shift of each view's detector (u, v) in pixels, from the measured views alone.

    Shifts that a moved object would cause as well are left out: the object stays where it is.
    Arguments and errors as `shared_misalignment`.
    """
    check_finite(views)
    shifts = torch.zeros(len(cameras), 2, dtype=torch.float64)
    history = []
    for _ in range(rounds):
        A = operator_of(misaligned(cameras, _shifted(shifts)))
        x = _volume(A, views, iterations)
        r = (views - A(x))[0, 0].flatten(1).double()
        history.append((r.norm() / views.double().norm()).item())
        columns = []
        for direction in STEP * torch.eye(2, dtype=torch.float64):
            ahead, behind = (
                operator_of(misaligned(cameras, _shifted(shifts + side * direction)))(x)
                for side in (1, -1)
            )
            columns.append((ahead - behind)[0, 0].flatten(1).double() / (2 * STEP))
        J = torch.stack(columns, dim=-1)
        change = torch.linalg.lstsq(J, r[..., None]).solution[..., 0]
        shifts = without_motion(cameras, shifts + change.clamp(-LONGEST, LONGEST))
    by = _shifted(shifts)
    return Estimate(misaligned(cameras, by), by, history)


def without_motion(cameras: Cameras, shifts: Float[Tensor, "m 2"]) -> Float[Tensor, "m 2"]:
    """Shifts of views in pixels, less those that a moved object would cause as well (three degrees
    of freedom, at the isocentre).
    """
    centre = isocentre(cameras)
    points = torch.cat([centre[None], centre + torch.eye(3).to(centre)])
    uv = cameras.project(points)[..., :2]
    moves = (uv[:, 1:] - uv[:, :1]).permute(0, 2, 1).reshape(-1, 3)
    amount = torch.linalg.lstsq(moves, shifts.reshape(-1, 1)).solution
    return shifts - (moves @ amount).reshape(-1, 2)


def _volume(A: LinearOperator, views: Tensor, iterations: int) -> Tensor:
    dtype = views.dtype if views.dtype == torch.float64 else torch.float32
    return sirt(A, views, iterations, weights=sirt_weights(A, dtype), momentum=True)


def _shared(free: Sequence[str], values: Float[Tensor, " k"]) -> Misalignment:
    by = Misalignment.none(1)
    for name, value in zip(free, values, strict=True):
        field, column = SHARED[name]
        getattr(by, field)[0, column] = value
    return by


def _shifted(shifts: Float[Tensor, "m 2"]) -> Misalignment:
    return Misalignment.none(len(shifts))._replace(offset_px=shifts)
