"""Central projection: X-ray cone beams and pinholes alike."""

from mvrecon.cameras.camera import Cameras
from mvrecon.geometry.grid import Grid
from mvrecon.projectors.base import Projector


class Drr(Projector):
    """Digitally reconstructed radiographs: integrals along the rays through each camera's point; see `Projector`.

    Order of accuracy in the voxel size: "joseph" two for smooth volumes, "siddon" one.

    Args:
        grid: where the voxels lie.
        cameras: a rig of central cameras.
        method: "joseph" or "siddon".
        backend: "auto", "cpu" or "reference".

    Raises:
        ValueError: a parallel rig, or as `Projector`.
    """

    def __init__(self, grid: Grid, cameras: Cameras, method: str = "joseph", backend: str = "auto"):
        if cameras.parallel:
            raise ValueError("The projector 'drr' needs central cameras, got a parallel rig; use 'radon'")
        super().__init__(grid, cameras, method, backend)
