"""Voxel-driven back-projection, as in filtered back-projection: every voxel reads the views at the
projection of its centre.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import Literal, NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from mvrecon.geometry.cameras.camera import Cameras
from mvrecon.geometry.grid import Grid
from mvrecon.geometry.lattice import centred_affine
from mvrecon.kernels import voxels
from mvrecon.kernels.operator import choose_backend, to_accumulation_dtype
from mvrecon.operators.checks import check
from mvrecon.operators.memo import grid_key, kept, place

Weight = Literal["none", "distance"]


def backproject(
    views: Float[Tensor, "b c m v u"],
    cameras: Cameras,
    grid: Grid,
    weight: Weight = "none",
    backend: str = "auto",
) -> Float[Tensor, "b c d h w"]:
    """Sum over cameras of each view at the projection of every voxel's centre, optionally with
    distance weights.

    Bilinear in the view; beyond the outermost pixel centres values fade to zero over one pixel.
    Only voxels within the range of their ray count: on the right side of the source, and for a
    segment before the detector. Second order in the pixel size. Not the adjoint of a projector,
    which is `LinearOperator.T`. Differentiable in the views by its exact transpose; derivatives in
    the cameras use the reference. Half and bfloat16 views are summed and returned in float32.

    Args:
        views: values on the detectors.
        cameras: the rig.
        grid: the voxels.
        weight: "none", or "distance" for 1 / w^2 = (SDD / z)^2, with z the voxel's depth from the
            source along the detector's normal and SDD the source's distance to the detector; 1 for
            parallel beams. Feldkamp, Davis and Kress, Practical cone-beam algorithm, JOSA A 1,
            1984, eq. 28 weigh with d^2 / (d + r . x)^2 = (SID / z)^2, d = SID from the source to
            the axis of rotation: that is (SID / SDD)^2 times this weight.
        backend: "cpu" or "cuda" (compiled), "reference" (torch, any device), or "auto".

    Raises:
        ValueError: an unknown weight or back end, a wrong rank, size or device.
        RuntimeError: "cuda" is not available, with the reason.
    """
    if weight not in ("none", "distance"):
        raise ValueError(f"Unknown weight {weight!r}. Known: none, distance")
    check(views, "views [b c m v u]", (len(cameras), *cameras.shape), views.device)
    return backproject_images(views, images_of(cameras, grid, views), weight == "distance", backend)


class Images(NamedTuple):
    """The images of every voxel of a grid in the views of a rig.

    Args:
        maps: maps as `image_maps` returns them, on the views' device.
        ray_extent: valid range of a ray, of the rig.
        shape: shape of the grid, (z, y, x).
    """

    maps: Float[Tensor, "m 4 2 3"]
    ray_extent: Sequence[float]
    shape: Sequence[int]


def images_of(cameras: Cameras, grid: Grid, like: Tensor) -> Images:
    """Return the images of a grid's voxels on the device of a tensor; cached unless the cameras may
    change.
    """

    def maps() -> Tensor:
        return image_maps(cameras, grid).to(like.device)

    key = "image maps", grid_key(grid), place(like)
    return Images(kept(cameras, key, maps), cameras.ray_extent, grid.shape)


def backproject_images(
    views: Float[Tensor, "b c m v u"], images: Images, weighted: bool, backend: str = "auto"
) -> Float[Tensor, "b c d h w"]:
    """`backproject` by precomputed images, without synchronisation."""
    values = to_accumulation_dtype(views)
    chosen = choose_backend(values, backend, "voxel_driven", voxels.self_test)
    act = voxels.backproject_reference if chosen == "reference" else voxels.backproject
    volumes = act(
        values.flatten(0, 1), images.maps, list(images.ray_extent), weighted, list(images.shape)
    )
    return volumes.unflatten(0, views.shape[:2])


def add_backprojection(
    total: Float[Tensor, "b c d h w"], views: Float[Tensor, "b c m v u"], images: Images
) -> None:
    """Add the back-projection with distance weights of precomputed images to volumes in place,
    without derivatives; on the CPU without memory for another volume.
    """
    if choose_backend(total, "auto", "voxel_driven", voxels.self_test) != "cpu":
        total += backproject_images(views, images, weighted=True)
        return
    from mvrecon.kernels.voxels import cpu  # compiles

    each, values = total.flatten(0, 1), views.flatten(0, 1)
    cpu.add_backprojection(each, values, images.maps, images.ray_extent, True)


def image_maps(cameras: Cameras, grid: Grid) -> Float[Tensor, "m 4 2 3"]:
    """Map centred voxel indices to (u w, v w, w) about the detector's centre, in float64.

    w is the fraction of the ray, positive on the valid side of the source, and 1 for parallel
    beams.
    """
    affine = centred_affine(grid).to(cameras.source)
    P = cameras.matrix @ affine
    fraction = replace(cameras, parallel=False).matrix[:, 2:] @ affine
    side = 1.0 if cameras.parallel or cameras.ray_extent[1] > 0 else -1.0
    centre = P.new_tensor([(n - 1) / 2 for n in cameras.shape[::-1]])[:, None]
    rows = torch.cat([side * (P[:, :2] - centre * P[:, 2:]), side * P[:, 2:], fraction], dim=1)
    growing = torch.cat([torch.zeros_like(rows[..., :2]), rows[..., 2:3]], dim=-1)
    return torch.stack([rows[..., [0, 1, 3]], growing], dim=-2)
