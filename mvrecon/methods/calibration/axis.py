"""The axis of rotation from one slice, at about the detector's resolution.

A calibration blurs the views by two of its coarse voxels, and so finds the axis of the object's
smooth part, where scatter and glare are. Here the residual is weighted by the square root of the
ramp filter, by which edges weigh as much as the rest. The normal operator A^T |f| A is then near
the identity (the filtered back-projection of a projection), so that a few conjugate gradients
suffice for each step of `from_data`.
"""

import math
import warnings
from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import avg_pool2d

from mvrecon.geometry.cameras.camera import Cameras
from mvrecon.geometry.cameras.field import resolution
from mvrecon.geometry.grid import Grid
from mvrecon.geometry.rigid import unit
from mvrecon.methods.calibration.alignment import Blur, RootRamp
from mvrecon.methods.calibration.from_data import (
    BLOB_SIGMA,
    MAX_LEFT_OUT,
    OperatorOf,
    Problem,
    derivatives,
    improved,
    unknowns,
)
from mvrecon.methods.classical.least_squares import cgls
from mvrecon.methods.classical.orbit import Orbit, orbit_of
from mvrecon.operators.operator import Projector

#: Voxels along the slice in each fit, the first of which has as many even of fewer views, and the
#: most views.
VOXELS, MAX_VIEWS = (48, 96, 192), 400
#: Band limit of the filter as a fraction of the voxels' Nyquist frequency.
CUTOFF = 0.5
#: Conjugate gradients in each round, rounds, and the step in pixels after which they end.
ITERATIONS, ROUNDS, MAX_FINAL_STEP = 8, 4, 0.02
#: Groups of consecutive views whose spread is the standard error, as neighbours err alike, and
#: standard errors in the uncertainty.
GROUPS, STANDARD_ERRORS = 24, 2.5
#: Uncertainty by the size of the voxels, relative to it: up to 0.08 was seen with 16 columns.
VOXEL_SHARE = 0.04


class Axis(NamedTuple):
    """A shift of all detectors along u and its uncertainty, in pixels; infinite where it was not
    found.
    """

    offset: float
    uncertainty: float


#: An axis that is not found.
KEPT = Axis(0.0, math.inf)


@torch.no_grad()
def refined_axis(
    operator_of: Callable[[Grid, Cameras], Projector],
    cameras: Cameras,
    views: Float[Tensor, "1 1 m v u"],
    grid: Grid,
    most_px: float,
) -> Axis:
    """Return the shift of all detectors along u that makes the views of one slice consistent, from
    a rig that is nearly right; 0 for a rig that has no such slice.

    The shift ends with the last size of voxels at which it predicts held-out views of the slice
    better than without, and well: those of an empty slice have nothing but noise. Voxels are
    halved down to a pixel's image, however coarse the grid is, as they bias the shift by a part of
    their size. The uncertainty is how much the last size changed it, and at least that part and
    `STANDARD_ERRORS` of the size where these are greatest, see `scatter`; these alone where a
    smaller size changed it no more.

    Args:
        operator_of: the operator of a rig on a grid.
        cameras: a rig on a circle, with rows across its axis.
        views: measured integrals.
        grid: its box contains the object.
        most_px: greatest shift in pixels.

    Warns:
        UserWarning: the slice's views are most consistent with a greater shift; it is 0, with that
            shift as its uncertainty.
    """
    try:
        orbit = orbit_of(cameras, grid)
    except ValueError:
        return KEPT
    every = math.ceil(len(cameras) / MAX_VIEWS)
    rig, views = cameras[::every], views[:, :, ::every]
    sides = _sides(grid, orbit)
    # to six decimals, so that rounding decides neither the slice nor its pixels
    wide = round(sides.max().item() / resolution(rig, orbit.centre), 6)
    most = max(len(rig), VOXELS[0])
    offset, uncertainty, least, noise = 0.0, math.inf, math.inf, 0.0
    for size in sorted({min(n, max(1, round(wide))) for n in VOXELS if n <= most}):
        box, pixels = _slice(grid, orbit, sides, size), wide / size
        rows, columns = max(1, min(round(pixels), rig.shape[0])), max(1, int(pixels / 2))
        middle = rig.project(orbit.centre[None])[:, 0, 1].median().item()
        first, last = round(round(middle, 6) - (rows - 1) / 2), rig.shape[1] // columns * columns
        if not 0 <= first <= rig.shape[0] - rows:
            break
        part = rig.cropped((first, first + rows), (0, last)).binned((rows, columns))
        y = avg_pool2d(views[0, :, :, first : first + rows, :last], (rows, columns))[None]
        cutoff = min(1.0, CUTOFF * columns / pixels)
        change, error = _change(partial(operator_of, box), part, y, cutoff)
        if change == 0:
            uncertainty = min(uncertainty, least)  # of the voxels before
            break
        noise = max(noise, columns * error)  # smaller voxels fit more of it
        offset, least = offset + columns * change, max(VOXEL_SHARE * pixels, noise)
        uncertainty = max(abs(columns * change), least)
        if abs(offset) > most_px:
            warnings.warn(
                f"The views of one slice shift the axis by {offset:.3g} pixels, expected at most "
                f"{most_px:.3g} by the fit to all views: it is not refined on the slice, and "
                f"uncertain by as much",
                stacklevel=2,
            )
            return Axis(0.0, abs(offset))
        rig = rig.shifted(columns * rig.source.new_tensor([[change, 0.0]]))
    return Axis(offset, uncertainty)


def _change(
    operator_of: OperatorOf, cameras: Cameras, y: Float[Tensor, "1 1 m 1 u"], cutoff: float
) -> Axis:
    """The shift of the slice's detectors, and its uncertainty by noise; 0 where it does not improve
    the prediction of held-out views. Steps oscillate about it, so it is their mean.
    """
    ramp = partial(RootRamp, cutoff=cutoff, device=y.device)
    shape, y = operator_of(cameras).domain_shape, ramp(y.shape[2:])(y)
    blobs = Blur(shape, [BLOB_SIGMA * (n > 1) for n in shape], y.device)
    problem = Problem(operator_of, cameras, unknowns(cameras, ["offset_u"]), blobs, y, ramp)
    values = still = problem.unknowns.basis.new_zeros(len(cameras), 1)
    x = cgls(problem.operator(values), y, ITERATIONS)
    for _ in range(ROUNDS):
        last = values
        values, x = improved(problem, values, x, ITERATIONS)
        if (values - last).abs().max() < MAX_FINAL_STEP:
            break
    values = (values + last) / 2
    without, left_out = (problem.left_out(at, ITERATIONS) for at in (still, values))
    if left_out >= min(without, MAX_LEFT_OUT):
        return KEPT
    A, r = problem.operator(values), problem.residual(values, x)
    effect = derivatives(lambda moved: problem.operator(moved)(x), values)[None]
    rest = effect - A(cgls(A, effect, ITERATIONS))  # what no volume explains
    pulls = (rest * r).sum(dim=(0, 1, 3, 4))  # of each view
    error = scatter(pulls) / rest.square().sum().item()
    return Axis(values[0, 0].item(), STANDARD_ERRORS * error)


def scatter(pulls: Float[Tensor, " m"]) -> float:
    """The standard deviation of the sum of the views' contributions, by groups of neighbours."""
    return torch.stack([part.sum() for part in pulls.tensor_split(GROUPS)]).norm().item()


def _sides(grid: Grid, orbit: Orbit) -> Float[Tensor, "3"]:
    """The lengths of a grid's box in mm along its axes, zero along that of rotation."""
    steps = grid.affine[:3, :3]
    lengths = steps.norm(dim=0) * steps.new_tensor(grid.size)
    lengths[int((unit(steps, dim=0).T @ orbit.axis.to(steps)).abs().argmax())] = 0
    return lengths


def _slice(grid: Grid, orbit: Orbit, sides: Float[Tensor, "3"], size: int) -> Grid:
    """One slice of a grid's box across the axis, about the orbit's plane and as thick as the box,
    so that a tilted row is inside it, in so many voxels along its longer side.
    """
    counts = torch.ceil(sides * (size / sides.max()) - 1e-6).clamp_min(1).int().tolist()
    shift = ((orbit.centre - grid.centre) @ orbit.axis) * orbit.axis
    return grid.divided(counts).moved(torch.eye(3), shift)
