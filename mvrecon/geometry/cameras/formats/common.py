"""Common parts of all geometry file formats: world axes, numbers from text, checks."""

import inspect
import math
import re
from collections.abc import Iterable, Mapping, Sequence
from itertools import takewhile
from pathlib import Path
from typing import Any, Literal, NamedTuple, get_args

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from mvrecon.core.files.atomic import write_text
from mvrecon.core.files.checks import (
    Refused,
    check_file,
    file_errors,
    npy_array,
    shown,
    text_of,
)
from mvrecon.core.files.keys import IMAGE_EFFECTS, has_effect, warn_of_unknown
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
    """Cameras in RAS mm from cameras in a file's axes; see `to_ras`.

    Raises:
        ValueError: an unknown name; all of several views have one camera.
    """
    vectors = torch.cat([cameras.source, cameras.origin, cameras.u, cameras.v], dim=-1)
    if len(vectors) > 1 and (vectors == vectors[0]).all():
        raise ValueError(f"expected views that differ, got one camera for all {len(vectors)}")
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
    for count, line in enumerate(text_of(path, strict=False).splitlines(), 1):
        words = re.split(r"[\s,;]+", line.partition("#")[0].strip())
        try:
            values = [number(word, f"line {count}") for word in words if word]
        except ValueError as error:
            raise Refused(f"{path}: {error}") from error
        if values:
            lines.append(values)
    return lines


#: Units of angles, in degrees.
UNITS = {
    "deg(rees?)?|°": 1.0,
    "m(illi.?)?rad(ian)?s?": math.degrees(1e-3),
    "grad(ian)?s?|gon": 0.9,
    "rad(ian)?s?": math.degrees(1),
    "arc.?min(ute)?s?": 1 / 60,
    "arc.?sec(ond)?s?": 1 / 3600,
    "turns|rev(olution)?s?": 360.0,
}
#: A unit as a name or a comment states it: alone, in brackets, behind an angle, a mark or "in"; not
#: as a quantity ("3 turns"), nor as another word ("rad. dose", "rev 2", "grad student").
STATED = (
    r"(^|_|[(\[:=/]|\bin|angles?|theta|rotation)\s*({0})\s*(\.?$|[)\],;(])|\bin\s+({0})(?![\w.])"
)
#: A whole number, or a name, in the first column of a table.
COUNTED = re.compile(r"\d+|.*[A-Za-z].*")


class Column(NamedTuple):
    """A column of numbers in a table.

    Args:
        what: name of the numbers in messages.
        names: pattern of the column's name.
        own: words in its name, or in the comment before it, that a warning names, see
            `has_effect`: by these the numbers are others.
        others: words in names of other columns that a warning names.
    """

    what: str
    names: re.Pattern
    own: Mapping[str, Any]
    others: Mapping[str, Any]


#: Angles; with another sense of rotation than the cameras', and what turns, moves or scales views.
ANGLES = Column(
    "angles",
    re.compile("angle|theta|rotation|degree", re.IGNORECASE),
    {r"(?<!counter.)(?<!anti.)(?<![a-z])(clockwise|cw)(?![a-z])": None},
    {**IMAGE_EFFECTS, "shift": 0},
)


def angles_in(path: str | Path, small_arc: bool = False) -> list[float]:
    """Angles in degrees, one per view: a NumPy file, or text with one number per line, or a table
    with names in its first line, whose column is the one with a name such as angle or theta, or
    that of `<file>:<column>`. A name, or a comment before the numbers, may state the unit.

    Args:
        path: path of the file.
        small_arc: the angles are degrees although they look like radians.

    Raises:
        FileNotFoundError: nothing is there.
        Refused: not one column of finite numbers, another unit, or too many.
    """
    name, angles = numbers_in(path, ANGLES)
    units = [
        (stated.start(), degrees)
        for unit, degrees in UNITS.items()
        if (stated := re.search(STATED.format(unit), name, re.IGNORECASE))
    ]
    if (factor := min(units, default=(0, 1.0))[1]) != 1:  # the first of several
        raise Refused(f"{path}: expected degrees, got {shown(name)}; multiply by {factor:.7g}")
    with file_errors(path, "has no angles", "expected one number per line, or a table"):
        check_degrees(angles, small_arc, "angles")
        check_turning(angles)
    return angles


def numbers_in(path: str | Path, wanted: Column) -> tuple[str, list[float]]:
    """Numbers, one for each view, as `angles_in` reads them, and the name of their column, or the
    comment before them, if any.

    Args:
        path: path of the file.
        wanted: the numbers' column.

    Raises:
        FileNotFoundError: nothing is there.
        Refused: not one column of finite numbers, or too many.
    """
    path, what = Path(path).expanduser(), wanted.what
    name, column = "", None
    if not path.exists():
        file, _, column = str(path).rpartition(":")
        path = Path(file) if Path(file).is_file() else path
    check_file(path, f"{what} as .npy, as text with one number per line, or as a table")
    with file_errors(path, f"has no {what}", "expected one number per line, or a table"):
        if path.suffix.lower() == ".npy":
            values = npy_array(path)
            if values.dtype.kind not in "iuf" or values.size != max(values.shape, default=0):
                raise Refused(f"{path}: expected numbers [m], got {values.dtype} {values.shape}")
            numbers = np.ravel(values[: VIEWS + 1]).astype(float).tolist()
            if not np.isfinite(numbers).all():
                raise Refused(f"{path}: expected finite {what}, got some that are NaN or infinite")
        else:
            name, numbers = _column(path, column, wanted)
        if not 0 < len(numbers) <= VIEWS:
            raise Refused(f"{path}: expected 1 to {VIEWS} {what}, got {len(numbers)}")
    return name, numbers


def _column(path: Path, column: str | None, wanted: Column) -> tuple[str, list[float]]:
    """The name of a column of a text, else the comment before it, and its numbers."""
    parts = [line.partition("#") for line in text_of(path, strict=False).splitlines()]
    lines = [line.strip(" ") for line, _, _ in parts if line.strip()]
    heads = takewhile(lambda part: not part[0].strip(), parts)
    title = " ".join(comment.strip() for _, _, comment in heads).strip()
    if all(re.fullmatch(r"[^,;\t]+[,;\t]?", line) for line in lines):
        lines = [line.rstrip(",;\t") for line in lines]
    mark = next((m for m in "\t;," if lines and m in lines[0]), None)  # else blanks
    rows = [[word.strip(" \"'") for word in line.split(mark)] for line in lines]
    names: list[str] = []
    if rows and not all(re.fullmatch(r"[-+.\deE]+", word) for word in rows[0]):
        names = rows.pop(0)
    widths = {*map(len, rows)}
    if names and mark is None and widths == {1}:
        names = [lines[0].strip(" \"'")]  # blanks are part of the name
    found = [k for k, name in enumerate(names) if wanted.names.search(name)]
    if column is not None:
        found = [k for k, name in enumerate(names) if name == column]
    elif widths == {1}:
        found = [0]
    if len(found) != 1:
        got = (
            f"the columns {', '.join(names)}" if names else f"{len(rows[0]) if rows else 0} columns"
        )
        raise Refused(
            f"{path}: expected one column of {wanted.what}, or <file>:<column>, got {got}"
        )
    if names and widths != {len(names)} or len(widths) != 1:
        raise Refused(
            f"{path}: expected as many numbers in every line{' as names' if names else ''}, got "
            f"{shown(sorted(widths))}; is it cut short, or are its decimals not points?"
        )
    if found[0]:
        _check_lines(path, names[0], [row[0] for row in rows])
    name = names[found[0]] if names else title
    unknown = [text for text in dict.fromkeys((name, title)) if has_effect(text, "", wanted.own)]
    others = (other for k, other in enumerate(names) if k != found[0])
    unknown += [other for other in others if has_effect(other, "", wanted.others)]
    warn_of_unknown(path, unknown)
    numbers = [number(row[found[0]], f"line {k}") for k, row in enumerate(rows, 1)]
    return name, numbers


def _check_lines(path: Path, name: str, texts: Sequence[str]) -> None:
    """Check that the lines of a table are in the order of its first column, if this counts them:
    whole numbers, or names of files that have one.

    Raises:
        Refused: they are in another, as that of names sorted as text: view_10 before view_2.
    """
    counts = [re.findall(r"\d+", Path(text).stem) for text in texts]
    if ANGLES.names.search(name) or not all(counts) or not all(map(COUNTED.fullmatch, texts)):
        return
    numbers = [int(count[-1]) for count in counts]
    if sorted(numbers) != numbers and (np.diff(sorted(numbers)) == 1).all():
        late = next(k for k, step in enumerate(np.diff(numbers)) if step < 0)
        raise Refused(
            f"{path}: expected lines in the order of the views, got {shown(texts[late])} before "
            f"{shown(texts[late + 1])}; sort them, or remove the first column if it is another "
            f"order"
        )


def rows_of(path: str | Path, lines: list[list[float]], width: int) -> Float[Tensor, "m k"]:
    """Convert lines of `width` numbers to a float64 tensor, one row per view.

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


def check_head(path: str | Path, asked: str) -> None:
    """Compare the first line of a file with the one that mvrecon writes for the same options.

    Args:
        path: path of a text file, of any program.
        asked: the line for the options of the reader.

    Raises:
        Refused: mvrecon wrote the file with other options.
    """
    head = text_of(path, strict=False).partition("\n")[0].strip()
    if head[:8] == asked[:8] and head != asked:  # such as "# ASTRA "
        raise Refused(f"{path}: expected options as its first line says, {head}, got {asked}")


def save_lines(path: str | Path, head: str, rows: Iterable[Iterable[float]], comma: str) -> None:
    """Write rows of numbers under a header line atomically, in full precision."""
    lines = [comma.join(repr(float(value)) for value in row) for row in rows]
    write_text(path, "\n".join([head, *lines]) + "\n")


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


def check_turning(degrees: Sequence[float]) -> None:
    """Raise if several views have one angle, as where a file was never filled.

    Raises:
        ValueError: they have.
    """
    if len(degrees) > 1 and min(degrees) == max(degrees):
        raise ValueError(
            f"expected angles that differ, got {degrees[0]:g} in all of {len(degrees)} views"
        )


def unmistakable(degrees: Sequence[float]) -> list[float]:
    """Angles in degrees to write, a full turn further where `check_degrees` would refuse them as
    radians.
    """
    like_radians = len(degrees) >= MANY and 0 < max(map(abs, degrees)) <= 2 * math.pi + 1e-3
    return [angle + 360 * like_radians for angle in degrees]


def check_distances(sids: float | Float[Tensor, " m"], sdds: float | Float[Tensor, " m"]) -> None:
    """Check that the source-axis distances (sid) of all views are positive mm and below the
    source-detector distances (sdd).

    Raises:
        ValueError: sid <= 0 or sid >= sdd.
    """
    sid, sdd = torch.as_tensor(sids).flatten(), torch.as_tensor(sdds).flatten()
    if (wrong := ~((sid > 0) & (sid < sdd))).any():
        view = int(wrong.int().argmax())
        raise ValueError(
            f"expected 0 < SID < SDD in mm (the axis between source and detector), got SID "
            f"{sid[view]:g} and SDD {sdd[view]:g}"
        )


def check_cone(cameras: Cameras, who: str) -> None:
    """Check that cameras are X-ray cone beams, for a format of nothing else.

    Raises:
        ValueError: parallel beams, or pinholes.
    """
    if cameras.parallel or cameras.extent != "segment":
        raise ValueError(f"expected X-ray cone beams for {who}, got another rig")


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
