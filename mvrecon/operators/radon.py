"""Parallel projection: the Radon transform of slices and the X-ray transform of volumes."""

from mvrecon.geometry.cameras.camera import Cameras, ExplicitRays
from mvrecon.operators.ray_transform import RayTransform


class Radon(RayTransform):
    """Integrals along parallel rays; see `RayTransform`.

    A grid of one slice under detectors of one row is the 2-D Radon transform. Detector rows along z
    see a stack of slices: the volume is then read by whole rows along z, several times faster than
    by tilted rays. Order of accuracy in the voxel size: "joseph" and "trilinear" two for smooth
    volumes, "siddon" one.

    Args:
        cameras: a rig of parallel beams.
        grid, method, backend, rays_per_pixel, skip, support: as in `RayTransform`.

    Raises:
        ValueError: central cameras, explicit rays, or as `RayTransform`.
    """

    @staticmethod
    def check_rig(cameras: Cameras | ExplicitRays) -> None:
        if not cameras.parallel:
            kind = "explicit rays" if isinstance(cameras, ExplicitRays) else "central cameras"
            raise ValueError(
                f"The projector 'radon' needs a parallel rig, got {kind}; use projector=drr"
            )
