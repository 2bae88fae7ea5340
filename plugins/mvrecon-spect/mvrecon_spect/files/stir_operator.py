"""The projector of a STIR system: holes, acceptance and the detector's blur from its files."""

from collections.abc import Sequence
from pathlib import Path
from typing import Unpack

import torch
from jaxtyping import Float
from torch import Tensor

from mvrecon.geometry.cameras.camera import Cameras
from mvrecon.geometry.grid import Grid
from mvrecon.operators.operator import LinearOperator, Projector, Scaled
from mvrecon_spect.files.interfile import read_header
from mvrecon_spect.files.stir import system_of
from mvrecon_spect.files.stir_system import StirSystem, accepted, cameras_of
from mvrecon_spect.files.stir_text import Opening
from mvrecon_spect.operators.matter import MuOption
from mvrecon_spect.operators.multiplexed import Multiplexed
from mvrecon_spect.operators.projector import Shared, Spect
from mvrecon_spect.operators.response import FWHM

#: Maximum distance of a camera from its position in the files, as a fraction of the distance from
#: hole to detector.
MOVED = 0.25


def operator_of(
    system: StirSystem,
    grid: Grid,
    mu: MuOption = None,
    blur: bool = False,
    world: str = "RAS",
    **shared: Unpack[Shared],
) -> LinearOperator:
    """Counts of a STIR system: volumes [b c d h w] in counts / mm^3 to views [b c m v u].

    Args:
        system: STIR system with holes of one size and shape, equally many per detector.
        grid: grid of the activity.
        mu: linear attenuation in 1/mm, as in `Spect`.
        blur: model the blur by the holes and by the detector's intrinsic resolution.
        world: axes of the files; see `cameras_of`.
        shared: see `Spect`.

    Pixels outside a hole's acceptance angles receive no counts from it; this cut is applied after
    the blur. STIR's files do not describe penetration of the edge.

    Raises:
        ValueError: holes of several sizes; see `Spect`.
    """
    A = _behind(system, system.openings, grid, cameras_of(system, world), blur, mu, **shared)
    return A if system.holes == 1 else Multiplexed(A, holes=system.holes)


def stir_projector(
    grid: Grid,
    cameras: Cameras,
    path: str | Path,
    detector_file: str | Path | None = None,
    collimator_file: str | Path | None = None,
    world: str = "RAS",
    blur: bool = True,
    mu: MuOption = None,
    **shared: Unpack[Shared],
) -> Projector:
    """Counts of some holes of a STIR system, with acceptance angles, hole size and intrinsic
    resolution from its files.

    Args:
        grid: grid of the activity.
        cameras: all or some cameras of `stir_pinhole`, possibly cropped, binned or calibrated; each
            is assigned to the nearest hole.
        path, detector_file, collimator_file, world: see `stir_pinhole`.
        blur: see `operator_of`.
        mu, shared: see `Spect`.

    Raises:
        ValueError: cameras at other positions; see `operator_of` and `stir_pinhole`.
    """
    system = system_of(read_header(path, "projections"), detector_file, collimator_file)
    known = cameras_of(system, world)
    apart = torch.cdist(_places(cameras), _places(known))
    nearest, far = apart.argmin(dim=1), apart.amin(dim=1).max().item()
    if far > (most := MOVED * known.distance.min().item()):
        raise ValueError(
            f"{path}: expected the cameras of this file, camera=stir_pinhole, each within "
            f"{most:.3g} mm of its hole, got one {far:.3g} mm away"
        )
    openings = [system.openings[hole] for hole in nearest.tolist()]
    return _behind(system, openings, grid, cameras, blur, mu, **shared)


def _behind(
    system: StirSystem,
    openings: Sequence[Opening],
    grid: Grid,
    cameras: Cameras,
    blur: bool,
    mu: MuOption,
    **shared: Unpack[Shared],
) -> Projector:
    """The projector of cameras, each behind one of the holes."""
    sizes = {(hole.shape, *hole.size_mm) for hole in system.openings}
    if len(sizes) != 1:
        raise ValueError(f"Expected holes of one shape and size, got {len(sizes)} different")
    shape, x, z = sizes.pop()
    if shape == "round" and x != z:
        raise ValueError(f"Expected round holes as wide as high, got {x:g} and {z:g} mm")
    table = isinstance(shared.get("response"), str | Path) and shared["response"] != "geometric"
    A = Spect(
        grid,
        cameras,
        diameter_mm=x if shape == "round" else (x, z),
        mu=mu,
        blur=blur,
        # a measured response contains the detector's
        intrinsic_mm=FWHM * system.detector.sigma_mm if blur and not table else 0.0,
        **shared,
    )
    mask = accepted(cameras, openings, system.pixel_mm)
    return A if mask.all() else Scaled(A, pixels=mask.double())


def _places(cameras: Cameras) -> Float[Tensor, "m 6"]:
    """Positions of holes and detector centres in mm."""
    return torch.cat([cameras.source, cameras.detector_centre], dim=1).detach().cpu().double()
