"""True views: closed-form integrals along thin rays, their mean over a pixel, their derivative.

The mean over a pixel is what a detector measures; a thin ray is what most projectors compute. Their
rankings differ, so a benchmark shows both.
"""

from dataclasses import dataclass
from functools import lru_cache

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn.functional import avg_pool2d

from mvrecon.data.scenes.solids import Phantom, voxelise
from mvrecon.geometry.cameras.camera import Cameras
from mvrecon.geometry.grid import Grid
from mvrecon.operators.ray_transform import RayTransform
from mvrecon_bench.benchmarks.cases import Case

#: Views whose derivative by the pose is compared, and rays across a pixel for it.
WATCHED, POSE_RAYS = 4, 2
#: Step of the central differences, in voxels.
STEP = 0.1


@dataclass(frozen=True, eq=False)
class Truth:
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
def truth_of(case: Case, rays: int) -> Truth:
    """The truth of a case (given as its `geometry`), with rays x rays to a pixel.

    The cotangent is white noise; `pose` is the derivative of sum(cotangent * pixel mean) by rigid
    motions of each of the watched cameras, see `pose_gradient`. A floor is the error of the exact
    integrals of the same voxels (Siddon in float64), that of the discretisation alone; an
    interpolating method may err less against the pixel average.
    """
    grid, rig, phantom = case.grid(), case.cameras(), case.phantom()
    volume = voxelise(phantom, grid)
    thin = phantom.integrals(*rig.rays(), ray_extent=rig.ray_extent)
    pixel = pixel_mean(phantom, rig, rays)
    watched = torch.linspace(0, len(rig) - 1, min(WATCHED, len(rig))).long()
    cotangent = torch.randn(thin.shape, generator=torch.Generator().manual_seed(0))
    pose = pose_gradient(phantom, rig[watched], cotangent[watched].double(), grid)
    exact = RayTransform(grid, rig, method="siddon")(volume.double()[None, None])[0, 0]
    floor_thin, floor_pixel = relative_error(exact, thin), relative_error(exact, pixel)
    return Truth(volume, cotangent, thin, pixel, floor_thin, floor_pixel, watched, pose)


def relative_error(views: Float[Tensor, "m v u"], truth: Float[Tensor, "m v u"]) -> float:
    """|views - truth| / |truth|, root mean square over all pixels."""
    return ((views.double() - truth).norm() / truth.norm()).item()


def pixel_mean(phantom: Phantom, cameras: Cameras, rays: int) -> Float[Tensor, "m v u"]:
    """Mean of the exact integrals over rays x rays rays that fill each pixel evenly, in float64."""
    views = (
        phantom.integrals(*one.rays(), ray_extent=one.ray_extent) for one in cameras.refined(rays)
    )
    return torch.cat([avg_pool2d(view, rays) for view in views])


def pose_gradient(
    phantom: Phantom, cameras: Cameras, weights: Float[Tensor, "m v u"], grid: Grid
) -> Float[Tensor, "m 6"]:
    """Derivative of sum(weights * pixel mean) by turns and shifts of each camera about the grid's
    centre.

    By central differences of the closed form. A turn is measured by the way in mm of a point half
    an edge of the volume away, so that all six are per mm.
    """
    step, arm = STEP * min(grid.spacing), arm_of(grid)
    columns = []
    for k in range(6):
        ahead, behind = (
            pixel_mean(phantom, moved(cameras, *motion(k, amount, arm), grid), POSE_RAYS)
            for amount in (step, -step)
        )
        columns.append((weights * (ahead - behind)).sum(dim=(1, 2)) / (2 * step))
    return torch.stack(columns, dim=1)


def motion(k: int, amount: float, arm: float) -> tuple[Float[Tensor, "3 3"], Float[Tensor, "3"]]:
    """A turn about axis k by amount / arm radians for k < 3, else a shift by the amount along axis
    k - 3.
    """
    eye = torch.eye(3, dtype=torch.float64)
    if k >= 3:
        return eye, amount * eye[k - 3]
    return torch.linalg.matrix_exp(
        torch.linalg.cross(eye[k].expand(3, 3), eye).T * amount / arm
    ), 0 * eye[0]


def moved(cameras: Cameras, R: Float[Tensor, "3 3"], t: Float[Tensor, "3"], grid: Grid) -> Cameras:
    """The rig turned by R about the grid's centre, then shifted by t."""
    return cameras.moved(R, t + grid.centre - R @ grid.centre)


def arm_of(grid: Grid) -> float:
    """Half the shortest edge of the volume in mm."""
    return min(n * step for n, step in zip(grid.shape[::-1], grid.spacing, strict=True)) / 2
