"""Parallel projection: the Radon transform of slices and the X-ray transform of volumes."""

from mvrecon.cameras.camera import Cameras
from mvrecon.geometry.grid import Grid
from mvrecon.projectors.base import Projector


class Radon(Projector):
    """Integrals along parallel rays; see `Projector`.

    A grid of one slice under detectors of one row is the 2-D Radon transform; detector rows along z see one slice each.
    Order of accuracy in the voxel size: "joseph" two for smooth volumes, "siddon" one.

    Args:
        grid: where the voxels lie.
        cameras: a rig of parallel beams.
        method: "joseph" or "siddon".
        backend: "auto", "cpu" or "reference".

    Raises:
        ValueError: a rig of central cameras, or as `Projector`.
    """

    def __init__(self, grid: Grid, cameras: Cameras, method: str = "joseph", backend: str = "auto"):
        if not cameras.parallel:
            raise ValueError("The projector 'radon' needs a parallel rig, got central cameras; use 'drr'")
        super().__init__(grid, cameras, method, backend)
