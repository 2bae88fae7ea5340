"""What all formats of geometry files share: axes of the world, numbers in text, and checks."""

import inspect
import math
import re
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, Literal, get_args

import torch
from jaxtyping import Float
from torch import Tensor

from mvrecon.core.files.atomic import written_whole
from mvrecon.core.files.checks import Refused, shown, text_of
from mvrecon.core.parts import CAMERAS
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
            superior; DICOM, ITK), or "IEC" (+x to the right of who faces the gantry, +y to the
            gantry, +z upwards).

    Convention: IEC 61217's fixed axes with the patient on his back, head first: x is the patient's
    left, y superior, z anterior.

    Raises:
        ValueError: another name.
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


#: The most views that a geometry file may have.
VIEWS = 2**16
#: From so many views on, angles within 2 pi are taken for radians.
MANY = 8


def flips_rows(camera: Mapping[str, Any]) -> bool:
    """Whether the rows of stored views must be reversed, `views.flip(-2)`, for a camera's settings.

    Args:
        camera: settings of a camera, its name and options; the option `flip_rows`, or the format's
            own default, decides.
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
    """The numbers of each line of a text file; commas, semicolons or blanks part them, # begins a
    comment.

    Raises:
        OSError: it cannot be read.
        Refused: too large, not text, or anything but finite numbers; the message names the line.
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
    """Lines of `width` numbers as a tensor in float64, one row a view.

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
    """Write rows of numbers under a first line, whole or not at all, to the last digit."""
    lines = [comma.join(repr(float(value)) for value in row) for row in rows]
    with written_whole(path) as part:
        part.write_text("\n".join([head, *lines]) + "\n", encoding="utf-8")


def check_degrees(degrees: list[float], insist: bool, what: str) -> None:
    """Refuse angles that look like radians: many views, and none beyond 2 pi.

    Args:
        degrees: angles of all views.
        insist: they are degrees, whatever they look like (`small_arc`).
        what: they are, for the message.

    Raises:
        ValueError: they look like radians.
    """
    most = max(map(abs, degrees))
    if not insist and len(degrees) >= MANY and 0 < most <= 2 * math.pi + 1e-3:
        raise ValueError(
            f"expected {what} in degrees, got {len(degrees)} views within {most:.4g}, which look "
            f"like radians; multiply by 57.29578, or say small_arc=true if these are degrees"
        )


def check_distances(sid: float, sdd: float) -> None:
    """Refuse a source-axis distance (sid) that is not positive mm, or not below the source-detector
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
    """Pixel size (v, u) in mm, for a format that has one for all views and right angles.

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
