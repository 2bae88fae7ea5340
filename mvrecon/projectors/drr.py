"""Central projection: X-ray cone beams, pinholes, and rays given one by one."""

from jaxtyping import Bool
from torch import Tensor

from mvrecon.cameras.camera import Cameras
from mvrecon.cameras.explicit import ExplicitRays
from mvrecon.geometry.grid import Grid
from mvrecon.projectors.ray_transform import RayTransform


class Drr(RayTransform):
    """Digitally reconstructed radiographs: integrals along the rays through each camera's point;
    see `RayTransform`.

    Order of accuracy in the voxel size: "joseph" and "trilinear" two for smooth volumes, "siddon"
    one.

    Args:
        grid: where the voxels lie.
        cameras: a rig of central cameras, or explicit rays.
        method: "joseph", "siddon", "trilinear" or "trilinear:<samples>".
        backend: "auto", "cpu", "cuda" or "reference".
        rays_per_pixel: rays each way over which a pixel is the mean.
        skip: what is left out of a volume, "auto", "off", "box", "brick" or "verify".
        support: the voxels that may be anything but zero.

    Raises:
        ValueError: a parallel rig, or as `RayTransform`.
    """

    def __init__(
        self,
        grid: Grid,
        cameras: Cameras | ExplicitRays,
        method: str = "joseph",
        backend: str = "auto",
        rays_per_pixel: int = 1,
        skip: str = "auto",
        support: Bool[Tensor, "d h w"] | None = None,
    ):
        if cameras.parallel:
            raise ValueError(
                "The projector 'drr' needs central cameras, got a parallel rig; use 'radon'"
            )
        super().__init__(grid, cameras, method, backend, rays_per_pixel, skip, support)
