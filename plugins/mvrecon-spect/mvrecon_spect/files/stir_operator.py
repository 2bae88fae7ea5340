"""The projector of a system of STIR: holes, acceptance and the detector's blur from its files."""

import math

from jaxtyping import Float
from torch import Tensor

from mvrecon.geometry.grid import Grid
from mvrecon.operators.operator import LinearOperator, Scaled
from mvrecon_spect.files.stir_system import StirSystem, accepted, cameras_of
from mvrecon_spect.multiplexed import Multiplexed
from mvrecon_spect.projector import Spect

#: FWHM of a Gaussian over its standard deviation.
FWHM = math.sqrt(8 * math.log(2))


def operator_of(
    system: StirSystem,
    grid: Grid,
    mu: Float[Tensor, "d h w"] | None = None,
    blur: bool = False,
    world: str = "RAS",
) -> LinearOperator:
    """Counts of a system of STIR: volumes [b c d h w] in counts / mm^3 to views [b c m v u].

    Args:
        system: holes of one size and shape, equally many on all detectors.
        grid: where the activity lies.
        mu: linear attenuation in 1/mm on the grid.
        blur: by the holes and by the detector's own standard deviation.
        world: axes of the files; see `cameras_of`.

    Pixels beyond a hole's angles of acceptance get nothing from it; with blur they are cut after
    it. What comes through the edge is not in STIR's files.

    Raises:
        ValueError: holes of several sizes; what `Spect` refuses.
    """
    sizes = {(hole.shape, *hole.size_mm) for hole in system.collimator.openings}
    if len(sizes) != 1:
        raise ValueError(f"Expected holes of one shape and size, got {len(sizes)} different")
    shape, x, z = sizes.pop()
    if shape == "round" and x != z:
        raise ValueError(f"Expected round holes as wide as high, got {x:g} and {z:g} mm")
    sigma = system.detector.sigma_mm
    A: LinearOperator = Spect(
        grid,
        cameras_of(system, world),
        diameter_mm=x if shape == "round" else (x, z),
        mu=mu,
        blur=blur,
        intrinsic_mm=FWHM * sigma if blur else 0.0,
    )
    mask = accepted(system)
    if not mask.all():
        A = Scaled(A, pixels=mask.double())
    return A if system.holes == 1 else Multiplexed(A, holes=system.holes)
