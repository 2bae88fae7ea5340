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

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import avg_pool2d

from mvrecon.geometry.cameras.camera import Cameras
from mvrecon.geometry.cameras.field import resolution
from mvrecon.geometry.grid import Grid, coarse
from mvrecon.geometry.rigid import unit
from mvrecon.methods.calibration.alignment import Blur, RootRamp
from mvrecon.methods.calibration.from_data import (
    BLOB_SIGMA,
    MAX_LEFT_OUT,
    OperatorOf,
    Problem,
    improved,
    unknowns,
)
from mvrecon.methods.classical.least_squares import cgls
from mvrecon.methods.classical.orbit import Orbit, orbit_of
from mvrecon.operators.operator import Projector

#: Voxels across the slice in the first fit, which are doubled up to the most, and the most views.
MIN_VOXELS, MAX_VOXELS, MAX_VIEWS = 48, 192, 400
#: Band limit of the filter as a fraction of the voxels' Nyquist frequency.
CUTOFF = 0.5
#: Conjugate gradients in each round, rounds, and the step in pixels after which they end.
ITERATIONS, ROUNDS, MAX_FINAL_STEP = 8, 4, 0.02


@torch.no_grad()
def refined_axis(
    operator_of: Callable[[Grid, Cameras], Projector],
    cameras: Cameras,
    views: Float[Tensor, "1 1 m v u"],
    grid: Grid,
    most_px: float,
) -> float:
    """Return the shift of all detectors along u, in pixels, that makes the views of one slice
    consistent, from a rig that is nearly right; 0 for a rig that has no such slice.

    The shift ends with the last size of voxels at which it predicts held-out views of the slice
    better than without, and well: those of an empty slice have nothing but noise.

    Args:
        operator_of: the operator of a rig on a grid.
        cameras: on a circle; their rows run across its axis.
        views: measured integrals.
        grid: its box contains the object.
        most_px: greatest shift.

    Warns:
        UserWarning: the slice's views are most consistent with a greater shift; it is 0.
    """
    try:
        orbit = orbit_of(cameras, grid)
    except ValueError:
        return 0.0
    every, size = math.ceil(len(cameras) / MAX_VIEWS), MIN_VOXELS
    offset, most = 0.0, min(MAX_VOXELS, math.ceil(len(cameras) / every))
    rig, views = cameras[::every], views[:, :, ::every]
    while size <= max(most, MIN_VOXELS):
        box = _slice(grid, orbit, size)
        across = max(mm for mm, n in zip(box.spacing, box.size, strict=True) if n > 1)
        pixels = across / resolution(rig, orbit.centre)
        rows, columns = max(1, min(round(pixels), rig.shape[0])), max(1, int(pixels / 2))
        middle = rig.project(orbit.centre[None])[:, 0, 1].median().item()
        first, last = round(middle - (rows - 1) / 2), rig.shape[1] // columns * columns
        if not 0 <= first <= rig.shape[0] - rows:
            return offset
        part = rig.cropped((first, first + rows), (0, last)).binned((rows, columns))
        y = avg_pool2d(views[0, :, :, first : first + rows, :last], (rows, columns))[None]
        change = _change(partial(operator_of, box), part, y, min(1.0, CUTOFF * columns / pixels))
        if change == 0:
            return offset
        offset += columns * change
        if abs(offset) > most_px:
            warnings.warn(
                f"The views of one slice shift the axis by {offset:.3g} pixels, expected at most "
                f"{most_px:.3g} by the fit to all views: it is not refined on the slice",
                stacklevel=2,
            )
            return 0.0
        rig = rig.shifted(columns * rig.source.new_tensor([[change, 0.0]]))
        size *= 2
    return offset


def _change(
    operator_of: OperatorOf, cameras: Cameras, y: Float[Tensor, "1 1 m 1 u"], cutoff: float
) -> float:
    """The shift of the slice's detectors; 0 where it does not improve the prediction of held-out
    views. Steps oscillate about it, so it is their mean.
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
    return values[0, 0].item() if left_out < min(without, MAX_LEFT_OUT) else 0.0


def _slice(grid: Grid, orbit: Orbit, most: int) -> Grid:
    """One slice of a grid's box across the axis, about the orbit's plane and as thick as the box,
    so that a tilted row is inside it, in at most so many voxels a side.
    """
    fine = coarse(grid, most)
    along = int((unit(fine.affine[:3, :3], dim=0).T @ orbit.axis).abs().argmax())
    size = [1 if axis == along else n for axis, n in enumerate(fine.size)]
    affine = fine.affine.clone()
    affine[:3, along] *= fine.size[along]
    thick = Grid((size[2], size[1], size[0]), affine)
    shift = fine.centre - thick.centre
    shift = shift + ((orbit.centre - fine.centre) @ orbit.axis) * orbit.axis
    return thick.moved(torch.eye(3), shift)
