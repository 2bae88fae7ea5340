"""Common parts of all geometry file formats: world axes, numbers from text, checks."""

import inspect
import math
import re
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Literal, get_args

import torch
from jaxtyping import Float
from torch import Tensor

from mvrecon.core.files.atomic import written_whole
from mvrecon.core.files.checks import Refused, shown, text_of
from mvrecon.core.parts import CAMERAS, CameraPart
from mvrecon.core.registry import hint
from mvrecon.geometry.cameras.camera import Cameras

World = Literal["RAS", "LPS", "IEC"]

_TO_RAS = {
    "RAS": [[1, 0, 0], [0, 1, 0], [0, 0, 1]],
    "LPS": [[-1, 0, 0], [0, -1, 0], [0, 0, 1]],
    "IEC": [[-1, 0, 0], [0, 0, 1], [0, 1, 0]],
}


def to_ras(world: str) -> Float[Tensor, "3 3"]:
    """Rotation from the axes of a geometry file to RAS, mvrecon's world, in mm.

    Args:
        world: "RAS" (+x right, +y anterior, +z superior; NIfTI), "LPS" (+x left, +y posterior, +z
            superior; DICOM, ITK), or "IEC" (+x to the right when facing the gantry, +y to the
            gantry, +z upwards).

    Convention: IEC 61217's fixed axes with the patient supine, head first: x is the patient's left,
    y superior, z anterior.

    Raises:
        ValueError: an unknown name.
    """
    if world not in _TO_RAS:
        raise ValueError(f"Unknown world {world!r}{hint(str(world), get_args(World))}")
    return torch.tensor(_TO_RAS[world], dtype=torch.float64)


def from_world(cameras: Cameras, world: str) -> Cameras:
    """Cameras in RAS mm from cameras in a file's axes; see `to_ras`."""
    return cameras.moved(to_ras(world), torch.zeros(3))


def into_world(cameras: Cameras, world: str) -> Cameras:
    """Cameras in a file's axes from cameras in RAS mm; the inverse of `from_world`."""
    return cameras.moved(to_ras(world).T, torch.zeros(3))


#: Maximum number of views in a geometry file.
VIEWS = 2**16
#: Number of views from which angles within 2 pi are assumed to be radians.
MANY = 8


def flips_rows(camera: CameraPart) -> bool:
    """Whether a camera's settings require reversed rows of stored views, `views.flip(-2)`.

    Args:
        camera: name and options of a camera; `flip_rows`, by default the format's, decides.
    """
    known = inspect.signature(CAMERAS.get(camera["name"])).parameters
    default = known["flip_rows"].default if "flip_rows" in known else False
    return bool(camera.get("flip_rows", default))


def number(text: str, what: str) -> float:
    """A finite number from text.

    Raises:
        ValueError: not a finite number; the message names `what`.
    """
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value) or "_" in text:
        raise ValueError(f"expected a finite number for {what}, got {shown(text)}")
    return value


def number_lines(path: str | Path) -> list[list[float]]:
    """Return the numbers of each line of a text file, separated by commas, semicolons or blanks; #
    begins a comment.

    Raises:
        OSError: it cannot be read.
        Refused: too large, not text, or not finite numbers; the message names the line.
    """
    lines = []
    for count, line in enumerate(text_of(path).splitlines(), 1):
        words = re.split(r"[\s,;]+", line.partition("#")[0].strip())
        try:
            values = [number(word, f"line {count}") for word in words if word]
        except ValueError as error:
            raise Refused(f"{path}: {error}") from error
        if values:
            lines.append(values)
    return lines


def rows_of(path: str | Path, lines: list[list[float]], width: int) -> Float[Tensor, "m k"]:
    """Convert lines of `width` numbers to a float64 tensor, one row a view.

    Raises:
        Refused: no line, lines of another length, or more than `VIEWS`.
    """
    lengths = {len(line) for line in lines}
    if lengths != {width} or len(lines) > VIEWS:
        raise Refused(
            f"{path}: expected 1 to {VIEWS} lines of {width} numbers, got {len(lines)} lines of "
            f"{shown(sorted(lengths))} numbers; is it cut short?"
        )
    return torch.tensor(lines, dtype=torch.float64)


def save_lines(path: str | Path, head: str, rows: Iterable[Iterable[float]], comma: str) -> None:
    """Write rows of numbers under a header line atomically, in full precision."""
    lines = [comma.join(repr(float(value)) for value in row) for row in rows]
    with written_whole(path) as part:
        part.write_text("\n".join([head, *lines]) + "\n", encoding="utf-8")


def check_degrees(degrees: list[float], insist: bool, what: str) -> None:
    """Raise if angles look like radians: many views, and none beyond 2 pi.

    Args:
        degrees: angles of all views.
        insist: skip the check (`small_arc`).
        what: name of the angles, for the message.

    Raises:
        ValueError: they look like radians.
    """
    most = max(map(abs, degrees))
    if not insist and len(degrees) >= MANY and 0 < most <= 2 * math.pi + 1e-3:
        raise ValueError(
            f"expected {what} in degrees, got {len(degrees)} views within {most:.4g}, which look "
            f"like radians; multiply by 57.29578, or set small_arc=true if these are degrees"
        )


def unmistakable(degrees: Sequence[float]) -> list[float]:
    """Angles in degrees to write, a full turn further where `check_degrees` would refuse them as
    radians.
    """
    like_radians = len(degrees) >= MANY and 0 < max(map(abs, degrees)) <= 2 * math.pi + 1e-3
    return [angle + 360 * like_radians for angle in degrees]


def check_distances(sid: float, sdd: float) -> None:
    """Check that the source-axis distance (sid) is positive mm and below the source-detector
    distance (sdd).

    Raises:
        ValueError: sid <= 0 or sid > sdd.
    """
    if not 0 < sid < sdd:
        raise ValueError(
            f"expected 0 < SID < SDD in mm (the axis between source and detector), got SID {sid:g} "
            f"and SDD {sdd:g}"
        )


def square_pixels(cameras: Cameras, who: str) -> tuple[float, float]:
    """Return the pixel size (v, u) in mm for a format with a single one and right angles.

    Raises:
        ValueError: detectors that are not rectangular, or sizes that differ between views.
    """
    u, v = cameras.u.norm(dim=-1), cameras.v.norm(dim=-1)
    skew = ((cameras.u * cameras.v).sum(dim=-1) / (u * v)).abs().max().item()
    spread = max(((step - step[0]).abs() / step[0]).max().item() for step in (u, v))
    if skew > 1e-6 or spread > 1e-6:
        raise ValueError(
            f"{who} has rectangular detectors of one pixel size, got rows and columns with the "
            f"cosine {skew:.3g} and sizes that differ by {100 * spread:.3g} %"
        )
    return v[0].item(), u[0].item()
