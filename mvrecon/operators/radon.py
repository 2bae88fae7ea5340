"""Parallel projection: the Radon transform of slices and the X-ray transform of volumes."""

from mvrecon.geometry.cameras.camera import Cameras, ExplicitRays
from mvrecon.operators.ray_transform import RayTransform


class Radon(RayTransform):
    """Integrals along parallel rays; see `RayTransform`, also for the other arguments.

    A grid of one slice under detectors of one row is the 2-D Radon transform. Detector rows along z
    see a stack of slices: the volume is then read by whole rows along z, several times faster than
    by tilted rays. Order of accuracy in the voxel size: "joseph" and "trilinear" two for smooth
    volumes, "siddon" one.

    Args:
        cameras: a rig of parallel beams.

    Raises:
        ValueError: central cameras, explicit rays, or as `RayTransform`.

    Examples:
        >>> rig = mv.parallel(60, detector={"pixels": [1, 48], "pixel_mm": 1.0})
        >>> A = mv.Radon(mv.Grid.centred(size=(32, 32, 1), spacing=1.0), rig)  # one slice
        >>> sinogram = A(torch.ones(1, 1, 1, 32, 32))
        >>> sinogram.shape, sinogram[0, 0, 0].max().item()  # the square is 32 mm wide
        (torch.Size([1, 1, 60, 1, 48]), 32.0)
    """

    @staticmethod
    def check_rig(cameras: Cameras | ExplicitRays) -> None:
        if not cameras.parallel:
            kind = "explicit rays" if isinstance(cameras, ExplicitRays) else "central cameras"
            raise ValueError(
                f"The projector 'radon' needs a parallel rig, got {kind}; use projector=drr"
            )
