"""Parallel projection: the Radon transform of slices and the X-ray transform of volumes."""

from jaxtyping import Bool
from torch import Tensor

from mvrecon.cameras.camera import Cameras
from mvrecon.cameras.explicit import ExplicitRays
from mvrecon.geometry.grid import Grid
from mvrecon.projectors.ray_transform import RayTransform


class Radon(RayTransform):
    """Integrals along parallel rays; see `RayTransform`.

    A grid of one slice under detectors of one row is the 2-D Radon transform. Detector rows along z
    see a stack of slices: the volume is then read as whole rows along z, several times faster than
    by rays that are tilted. Order of accuracy in the voxel size: "joseph" and "trilinear" two for
    smooth volumes, "siddon" one.

    Args:
        grid: where the voxels lie.
        cameras: a rig of parallel beams.
        method: "joseph", "siddon", "trilinear" or "trilinear:<samples>".
        backend: "auto", "cpu", "cuda" or "reference".
        rays_per_pixel: rays each way over which a pixel is the mean.
        skip: what is left out of a volume, "auto", "off", "box", "brick" or "verify".
        support: the voxels that may be anything but zero.

    Raises:
        ValueError: central cameras, explicit rays, or as `RayTransform`.
    """

    def __init__(
        self,
        grid: Grid,
        cameras: Cameras,
        method: str = "joseph",
        backend: str = "auto",
        rays_per_pixel: int = 1,
        skip: str = "auto",
        support: Bool[Tensor, "d h w"] | None = None,
    ):
        if not cameras.parallel:
            kind = "explicit rays" if isinstance(cameras, ExplicitRays) else "central cameras"
            raise ValueError(f"The projector 'radon' needs a parallel rig, got {kind}; use 'drr'")
        super().__init__(grid, cameras, method, backend, rays_per_pixel, skip, support)
