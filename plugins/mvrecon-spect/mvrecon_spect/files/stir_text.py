"""STIR's text files of a pinhole system in cm: detector file and collimator file.

Every value follows a colon; lines without a colon are comments. STIR identifies values by their
position and ignores their names. The names are checked here, since an extra line would shift all
subsequent values.
"""

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, NamedTuple

from mvrecon.core.files.atomic import written_whole
from mvrecon.core.files.checks import Refused, shown, text_of
from mvrecon.geometry.cameras.formats.common import VIEWS
from mvrecon_spect.files.interfile import number_in

#: mm per cm.
CM = 10.0
#: Units that may follow a name or a value, and the units of lengths (and attenuation) and angles.
UNIT = re.compile(
    r"(?<![a-z])(nm|[uµμ]?m|[mc]m|g|inch(?:es)?|deg(?:rees?)?|rad(?:ians?)?|°)(?![a-z])"
)
UNITS = {"cm": {"cm"}, "deg": {"deg", "degree", "degrees", "°"}}
WIDTH = 11


class Ring(NamedTuple):
    """A ring of detectors about the axis: number of detectors, angle of the first and angular step
    in degrees, axial position of the centre in mm.
    """

    count: int
    first_degrees: float
    step_degrees: float
    z_mm: float = 0.0


class DetectorText(NamedTuple):
    """Contents of a detector file: the standard deviation of the intrinsic resolution and the
    thickness of the crystal in mm, the crystal's attenuation in 1/mm, and the rings.
    """

    sigma_mm: float
    crystal_mm: float
    crystal_mu: float
    rings: tuple[Ring, ...]


@dataclass(frozen=True)
class Opening:
    """A hole of a collimator.

    Args:
        detector: index of the detector behind it, from 0.
        place_mm: position along the detector's rows x', outward from the collimator's radius y',
            and along the axis z from the detector's centre. For the model `cyl` the first is an
            angle in degrees.
        shape: "round" or "rect".
        size_mm: size along x' and z.
        axis_degrees: tilt of the hole's axis in the planes x'y' and zy'.
        acceptance_degrees: half-angle of acceptance about that axis in the same planes.
    """

    detector: int
    place_mm: tuple[float, float, float]
    shape: Literal["round", "rect"]
    size_mm: tuple[float, float]
    axis_degrees: tuple[float, float] = (0.0, 0.0)
    acceptance_degrees: tuple[float, float] = (45.0, 45.0)


class CollimatorText(NamedTuple):
    """Contents of a collimator file: "pol" (flat faces) or "cyl" (a cylinder), radius and thickness
    of the wall in mm, and the holes.
    """

    model: Literal["pol", "cyl"]
    radius_mm: float
    wall_mm: float
    openings: tuple[Opening, ...]


def read_detector(path: str | Path) -> DetectorText:
    """Read STIR's detector file (in cm and degrees), converting to mm.

    Raises:
        OSError: the file cannot be read.
        Refused: missing or misplaced values, values out of range, or a wrong unit.
    """
    path = Path(path)
    fields = _Fields(path)
    count = fields.whole("number of rings")
    sigma = CM * fields.number("sigma", "cm")
    crystal = CM * fields.number("crystal thickness", "cm")
    attenuation = fields.number("crystal attenuation coefficient", "cm") / CM
    rings = tuple(
        Ring(
            fields.whole("nangles"),
            fields.number("ang0", "deg"),
            fields.number("incr", "deg"),
            CM * fields.number("z0", "cm"),
        )
        for _ in range(count)
    )
    fields.finish()
    if min(sigma, crystal, attenuation) < 0:
        raise Refused(
            f"{path}: expected no negative sigma, thickness or attenuation, got {sigma / CM:g} cm, "
            f"{crystal / CM:g} cm and {CM * attenuation:g} / cm"
        )
    return DetectorText(sigma, crystal, attenuation, rings)


def write_detector(path: str | Path, text: DetectorText) -> None:
    """Write STIR's detector file in cm and degrees, atomically."""
    lines = [
        "Detector of a pinhole system, as STIR reads it",
        f"Number of rings: {len(text.rings)}",
        f"Sigma (cm): {_word(text.sigma_mm / CM)}",
        f"Crystal thickness (cm): {_word(text.crystal_mm / CM)}",
        f"Crystal attenuation coefficient (cm -1): {_word(text.crystal_mu * CM)}",
    ]
    for ring in text.rings:
        lines += [
            f"Nangles: {ring.count}",
            f"ang0 (deg): {_word(ring.first_degrees)}",
            f"incr (deg): {_word(ring.step_degrees)}",
            f"z0 (cm): {_word(ring.z_mm / CM)}",
        ]
    with written_whole(path) as part:
        part.write_text("\n".join(lines) + "\n", encoding="utf-8")


def read_collimator(path: str | Path) -> CollimatorText:
    """Read STIR's collimator file (in cm and degrees), converting to mm.

    Raises:
        OSError: the file cannot be read.
        Refused: missing or misplaced values, an unknown model or shape, a wrong number of holes, or
            a wrong unit.
    """
    path = Path(path)
    fields = _Fields(path)
    model = fields.text("model").lower()
    if model not in ("pol", "cyl"):
        raise Refused(f"{path}: expected the model pol or cyl, got {model!r}")
    radius = CM * fields.number("collimator radius", "cm")
    wall = CM * fields.number("wall thickness", "cm")
    count = fields.whole("number of holes")
    openings = tuple(_opening(path, line, model) for line in fields.rest())
    if len(openings) != count or not radius > 0:
        raise Refused(
            f"{path}: expected {count} holes at a positive radius, got {len(openings)} at "
            f"{radius / CM:g} cm; is it cut short?"
        )
    return CollimatorText(model, radius, wall, openings)  # type: ignore[arg-type]


def write_collimator(path: str | Path, text: CollimatorText) -> None:
    """Write STIR's collimator file in cm and degrees, atomically."""
    place = "x(cm)" if text.model == "pol" else "ang(deg)"
    lines = [
        "Collimator of a pinhole system, as STIR reads it",
        f"Model (cyl/pol): {text.model}",
        f"Collimator radius (cm): {_word(text.radius_mm / CM)}",
        f"Wall thickness (cm): {_word(text.wall_mm / CM)}",
        f"Number of holes: {len(text.openings)}",
        f"nh / ind / {place} / y(cm) / z(cm) / shape / sizex(cm) / sizez(cm) / angx(deg) / "
        "angz(deg) / accx(deg) / accz(deg)",
    ]
    for index, hole in enumerate(text.openings, 1):
        first = hole.place_mm[0] / (CM if text.model == "pol" else 1.0)
        lengths = [first, *(value / CM for value in hole.place_mm[1:])]
        rest = [*(size / CM for size in hole.size_mm), *hole.axis_degrees, *hole.acceptance_degrees]
        words = [*map(_word, lengths), hole.shape, *map(_word, rest)]
        lines.append(f"h{index}: {hole.detector + 1} {' '.join(words)}")
    with written_whole(path) as part:
        part.write_text("\n".join(lines) + "\n", encoding="utf-8")


def _word(value: float) -> str:
    """All digits of a number, of whatever type."""
    return repr(float(value))


class _Fields:
    """Reads the values of a text file in order, checking the beginning of each name."""

    def __init__(self, path: Path):
        self.path = path
        lines = [line.partition(":") for line in text_of(path).splitlines()]
        self._fields: Iterator[Sequence[str]] = iter(
            [(name, value) for name, colon, value in lines if colon]
        )
        texts = [line.strip().lower() for line, colon, _ in lines if not colon]
        columns = " ".join(line for line in texts if line.startswith("nh"))
        if others := set(UNIT.findall(columns)) - UNITS["cm"] - UNITS["deg"]:
            raise Refused(f"{path}: expected columns in cm and deg, got {sorted(others)}")

    def text(self, name: str, unit: str = "") -> str:
        stated, value = next(self._fields, ("", ""))
        words = re.sub(r"\s+", " ", stated.strip().lower())
        if not words.startswith(name) or not value.strip():
            raise Refused(
                f"{self.path}: expected a line '{name}: value', got "
                f"{shown(stated + ': ' + value)}; is a line missing?"
            )
        first, *comment = value.lower().split()
        found = set(UNIT.findall(f"{words.removeprefix(name)} {' '.join(comment)}"))
        if unit and (others := found - UNITS[unit]):
            got = " and ".join(sorted(others))
            raise Refused(f"{self.path}: expected {name!r} in {unit}, got it in {got}")
        return first

    def number(self, name: str, unit: str) -> float:
        return number_in(self.path, self.text(name, unit), name)

    def whole(self, name: str) -> int:
        value = number_in(self.path, self.text(name), name)
        if value != int(value) or not 1 <= value <= VIEWS:
            raise Refused(f"{self.path}: expected 1 to {VIEWS} for {name!r}, got {value:g}")
        return int(value)

    def rest(self) -> list[str]:
        return [value for _, value in self._fields]

    def finish(self) -> None:
        if rest := self.rest():
            raise Refused(f"{self.path}: expected no value behind the last ring, got {shown(rest)}")


def _opening(path: Path, line: str, model: str) -> Opening:
    words = line.split()
    if len(words) != WIDTH or words[4] not in ("round", "rect"):
        raise Refused(
            f"{path}: expected {WIDTH} values of a hole (detector, place, round or rect, sizes, "
            f"angles), got {shown(line.strip())}"
        )
    detector, *place = (number_in(path, word, "a hole") for word in words[:4])
    *size, tilt_x, tilt_z, accept_x, accept_z = (number_in(path, w, "a hole") for w in words[5:])
    if detector != int(detector) or not 1 <= detector <= VIEWS or min(size) <= 0:
        raise Refused(
            f"{path}: expected a detector from 1 on and positive sizes, got {shown(line.strip())}"
        )
    first = place[0] * (CM if model == "pol" else 1.0)
    return Opening(
        detector=int(detector) - 1,
        place_mm=(first, CM * place[1], CM * place[2]),
        shape=words[4],  # type: ignore[arg-type]
        size_mm=(CM * size[0], CM * size[1]),
        axis_degrees=(tilt_x, tilt_z),
        acceptance_degrees=(accept_x, accept_z),
    )
