"""Read and write STIR's pinhole measurements (PinholeSPECTUB): Interfile and two text files."""

from pathlib import Path
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from mvrecon.core.files.checks import Refused
from mvrecon.geometry.cameras.camera import Cameras
from mvrecon_spect.files.interfile import (
    Header,
    check_repeated,
    numbers_of,
    read_header,
    write_interfile,
)
from mvrecon_spect.files.interfile_keys import IMAGES
from mvrecon_spect.files.stir_system import StirSystem, cameras_of
from mvrecon_spect.files.stir_text import (
    DetectorText,
    read_collimator,
    read_detector,
    write_collimator,
    write_detector,
)

#: Tolerance in degrees between header and detector file.
DEGREES = 0.05


class StirScan(NamedTuple):
    """A measurement: the system and its counts [1 1 m v u]."""

    system: StirSystem
    counts: Float[Tensor, "1 1 m v u"]


def read_stir(
    path: str | Path,
    detector_file: str | Path | None = None,
    collimator_file: str | Path | None = None,
) -> StirScan:
    """Read a STIR pinhole measurement: geometry in mm and counts.

    Args:
        path: path of the Interfile header, .hs.
        detector_file, collimator_file: STIR's text files, in cm. None: detector.txt and
            collimator.txt in the header's folder.

    Raises:
        FileNotFoundError: a file does not exist.
        Refused: missing or inconsistent entries, also between header and detector file.
        ValueError: an impossible geometry; see `StirSystem`.
    """
    header = read_header(path, "projections")
    system = system_of(header, detector_file, collimator_file)
    numbers = numbers_of(header, (len(system.angles), *system.shape))
    counts = torch.from_numpy(numbers.read(0, len(system.angles)))
    if not (counts.isfinite().all() and (counts >= 0).all()):
        raise Refused(f"{path}: expected counts, finite and not negative, got others")
    return StirScan(system, counts[None, None])


def system_of(
    header: Header, detector_file: str | Path | None, collimator_file: str | Path | None
) -> StirSystem:
    """The geometry of STIR's pinhole system in mm; see `read_stir`."""
    detector_file = detector_file or header.path.parent / "detector.txt"
    collimator_file = collimator_file or header.path.parent / "collimator.txt"
    detector = read_detector(detector_file)
    views, rows, columns = views_shape(header)
    if sum(ring.count for ring in detector.rings) != views:
        raise Refused(
            f"{detector_file}: expected as many angles as there are projections in "
            f"{header.path}, {views}, got {sum(ring.count for ring in detector.rings)}"
        )
    _check_rotation(header, detector)
    down, along = (header.positive(f"scaling factor (mm/pixel) [{axis}]") for axis in (2, 1))
    return StirSystem(
        shape=(rows, columns),
        pixel_mm=(down, along),
        radius_mm=header.positive("radius"),
        detector=detector,
        collimator=read_collimator(collimator_file),
    )


def views_shape(header: Header) -> tuple[int, int, int]:
    """Number of projections, rows and columns in a header."""
    keys = ("number of projections", "matrix size [2]", "matrix size [1]")
    views, rows, columns = (header.whole(key) for key in keys)
    if min(views, rows, columns) < 1:
        raise Refused(
            f"{header.path}: expected projections with pixels, got {views, rows, columns}"
        )
    repeated = ["matrix size [3]", *IMAGES]
    check_repeated(header, repeated, views, "as the number of projections")
    return views, rows, columns


def stir_pinhole(
    path: str | Path,
    detector_file: str | Path | None = None,
    collimator_file: str | Path | None = None,
    world: str = "RAS",
) -> Cameras:
    """Rig of pinholes in mm from STIR's files, with one hole per detector.

    Args:
        path, detector_file, collimator_file: see `read_stir`.
        world: axes of the files, "RAS", "LPS" or "IEC"; see `cameras_of`.

    Raises:
        ValueError: several holes per detector, which require `operator_of`; see `read_stir`.
    """
    system = system_of(read_header(path, "projections"), detector_file, collimator_file)
    if system.holes != 1:
        raise ValueError(
            f"{path}: expected one hole a detector for a rig of cameras, got {system.holes}; "
            f"mvrecon_spect.files.stir_operator.operator_of adds up their images"
        )
    return cameras_of(system, world)


def write_stir(folder: str | Path, scan: StirScan, name: str = "counts") -> None:
    """Write a pinhole measurement for STIR: <name>.hs, <name>.s, detector.txt and
    collimator.txt.

    Raises:
        ValueError: counts whose shape is not the system's, negative or not finite; or several
            rings, whose angles the header cannot represent.
    """
    system, counts = scan
    shape = (len(system.angles), *system.shape)
    if tuple(counts.shape) != (1, 1, *shape) or not (counts.isfinite() & (counts >= 0)).all():
        raise ValueError(f"Expected counts [1 1 {shape}], not negative, got {tuple(counts.shape)}")
    if len(system.detector.rings) != 1:
        raise ValueError(f"Expected one ring, got {len(system.detector.rings)}")
    folder, ring = Path(folder), system.detector.rings[0]
    write_detector(folder / "detector.txt", system.detector)
    write_collimator(folder / "collimator.txt", system.collimator)
    lines = [
        "!imaging modality := nucmed",
        "!version of keys := 3.3",
        "!type of data := Tomographic",
        f"!matrix size [1] := {system.shape[1]}",
        f"!matrix size [2] := {system.shape[0]}",
        f"scaling factor (mm/pixel) [1] := {float(system.pixel_mm[1])!r}",
        f"scaling factor (mm/pixel) [2] := {float(system.pixel_mm[0])!r}",
        f"!number of projections := {ring.count}",
        f"!extent of rotation := {abs(float(ring.count * ring.step_degrees))!r}",
        "!process status := acquired",
        f"!direction of rotation := {'CCW' if ring.step_degrees > 0 else 'CW'}",
        f"start angle := {float(ring.first_degrees)!r}",
        "orbit := Circular",
        f"radius := {float(system.radius_mm)!r}",
    ]
    write_interfile(folder / f"{name}.hs", ".s", lines, counts[0, 0].detach().cpu().numpy())


def _check_rotation(header: Header, detector: DetectorText) -> None:
    """Check that the header's angles are those of the detector file, which STIR uses."""
    ring = detector.rings[0]
    turns = header.text("direction of rotation", "ccw" if ring.step_degrees > 0 else "cw")
    start = header.number("start angle", ring.first_degrees)
    first = header.number("first projection angle in data set", start)
    arc = header.number("extent of rotation", ring.count * abs(ring.step_degrees))
    arcs = [abs(ring.step_degrees) * count for count in (ring.count, ring.count - 1)]
    off = max(abs((angle - ring.first_degrees + 180) % 360 - 180) for angle in (start, first))
    if len(detector.rings) > 1:
        return
    if turns not in ("cw", "ccw") or (turns == "ccw") != (ring.step_degrees > 0) or off > DEGREES:
        raise Refused(
            f"{header.path}: expected the detector file's angles, from {ring.first_degrees:g} "
            f"degrees on by {ring.step_degrees:g} (CCW: positive), got a start at {start:g}, "
            f"the first projection at {first:g}, {turns}"
        )
    if not any(abs(arc - known) <= max(DEGREES, 1e-3 * known) for known in arcs):
        raise Refused(
            f"{header.path}: expected an extent of {arcs[0]:g} degrees (or {arcs[1]:g}), as the "
            f"detector file has it, got {arc:g}"
        )
