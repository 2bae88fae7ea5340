"""Central projection: X-ray cone beams, pinholes, and explicit rays."""

from mvrecon.geometry.cameras.camera import Cameras, ExplicitRays
from mvrecon.operators.ray_transform import RayTransform


class Drr(RayTransform):
    """Digitally reconstructed radiographs: integrals along the rays through each camera's point;
    see `RayTransform`, also for the other arguments.

    Order of accuracy in the voxel size: "joseph" and "trilinear" two for smooth volumes, "siddon"
    one.

    Args:
        cameras: a rig of central cameras, or explicit rays.

    Raises:
        ValueError: a parallel rig, or as `RayTransform`.

    Examples:
        >>> rig = mv.circular(8, sid=200, sdd=300, detector={"pixels": [16, 16], "pixel_mm": 6.0})
        >>> A = mv.Drr(mv.Grid.centred(8, spacing=4.0), rig)
        >>> x = torch.ones(1, 1, 8, 8, 8, requires_grad=True)
        >>> y = A(x)  # views [b c m v u] in (unit of x) * mm
        >>> torch.equal(torch.autograd.grad(y.sum(), x)[0], A.T(torch.ones_like(y)))
        True
    """

    @staticmethod
    def check_rig(cameras: Cameras | ExplicitRays) -> None:
        if cameras.parallel:
            raise ValueError(
                "The projector 'drr' needs central cameras, got a parallel rig; use projector=radon"
            )
