"""True views: closed-form integrals along thin rays, their mean over a pixel, and their
derivative.

A detector measures the mean over a pixel, but most projectors compute a thin ray. The rankings
differ, so benchmarks report both.
"""

from collections.abc import Sequence
from functools import lru_cache
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from mvrecon.data.scenes.solids import Phantom, voxelise
from mvrecon.geometry.cameras.camera import Cameras
from mvrecon.geometry.grid import Grid
from mvrecon.operators.ray_transform import RayTransform
from mvrecon.testing.measures import gap
from mvrecon_bench.benchmarks.cases import Workload

#: Number of views with a pose derivative, and rays per pixel axis for it.
WATCHED, POSE_RAYS = 4, 2
#: Step of the central differences, in voxels.
STEP = 0.1


class Truth(NamedTuple):
    """Truth of one case; see `truth_of`."""

    volume: Float[Tensor, "d h w"]
    cotangent: Float[Tensor, "m v u"]
    thin: Float[Tensor, "m v u"]
    pixel: Float[Tensor, "m v u"]
    floor_thin: float
    floor_pixel: float
    watched: Int[Tensor, " k"]
    pose: Float[Tensor, "k 6"]


@lru_cache(maxsize=4)
def truth_of(case: Workload, rays: int) -> Truth:
    """The truth of a case (given by its `geometry`), with rays x rays rays per pixel.

    The cotangent is white noise; `pose` is the derivative of sum(cotangent * pixel mean) with
    respect to rigid motions of each watched camera, see `pose_gradient`. An error floor is the
    discretisation error, i.e. that of the exact integrals of the same voxels (Siddon in float64);
    an interpolating method may have a smaller error for the pixel average.
    """
    grid, rig, phantom = case.grid(), case.cameras(), case.phantom()
    volume = voxelise(phantom, grid)
    thin, pixel = phantom.views(rig), phantom.views(rig, rays)
    watched = torch.linspace(0, len(rig) - 1, min(WATCHED, len(rig))).long()
    cotangent = torch.randn(thin.shape, generator=torch.Generator().manual_seed(0))
    pose = pose_gradient(phantom, rig[watched], cotangent[watched].double(), grid)
    exact = RayTransform(grid, rig, method="siddon")(volume.double()[None, None])[0, 0]
    return Truth(volume, cotangent, thin, pixel, gap(exact, thin), gap(exact, pixel), watched, pose)


def pose_gradient(
    phantom: Phantom, cameras: Cameras, weights: Float[Tensor, "m v u"], grid: Grid
) -> Float[Tensor, "m 6"]:
    """Derivative of sum(weights * pixel mean) with respect to rotations about the grid's centre and
    translations of each camera.

    Uses central differences of the closed form. Rotations are measured by the displacement in mm of
    a point at half an edge of the volume, so that all six derivatives are per mm.
    """
    step, columns = STEP * min(grid.spacing), []
    for k in range(6):
        ahead, behind = (
            phantom.views(moved(cameras, k, amount, grid), POSE_RAYS) for amount in (step, -step)
        )
        columns.append((weights * (ahead - behind)).sum(dim=(1, 2)) / (2 * step))
    return torch.stack(columns, dim=1)


def moved(cameras: Cameras, k: int, amount: float, grid: Grid) -> Cameras:
    """The rig rotated about axis k through the grid's centre for k < 3, by amount / arm radians;
    otherwise translated by the amount along axis k - 3.
    """
    eye = torch.eye(3, dtype=torch.float64)
    if k >= 3:
        return cameras.moved(eye, amount * eye[k - 3])
    generator = torch.linalg.cross(eye[k].expand(3, 3), eye).T
    R = torch.linalg.matrix_exp(generator * amount / arm_of(grid))
    return cameras.moved(R, grid.centre - R @ grid.centre)


def arm_of(grid: Grid) -> float:
    """Half the shortest edge of the volume in mm."""
    return min(n * step for n, step in zip(grid.shape[::-1], grid.spacing, strict=True)) / 2


def rigid(
    gradients: Sequence[Float[Tensor, "m 3"]], cameras: Cameras, grid: Grid
) -> Float[Tensor, "m 6"]:
    """Convert derivatives with respect to a camera's four vectors to those with respect to its
    rotations and translations, as in `pose_gradient`.
    """
    source, origin, u, v = (g.detach().double().cpu() for g in gradients)
    arms = cameras.source - grid.centre, cameras.origin - grid.centre, cameras.u, cameras.v
    pairs = zip(arms, (source, origin, u, v), strict=True)
    turn = torch.stack([torch.linalg.cross(arm, g) for arm, g in pairs]).sum(dim=0)
    return torch.cat([turn / arm_of(grid), source + origin], dim=1)


def cosine(a: Tensor, b: Tensor) -> float:
    """Cosine of the angle between two gradients."""
    return torch.nn.functional.cosine_similarity(a.flatten(), b.flatten(), dim=0).item()
