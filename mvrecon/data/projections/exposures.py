"""What files state of the exposure and the beam of views and of their fields: compared, and applied
by name.
"""

import math
import re
import warnings
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from jaxtyping import Float

from mvrecon.core.files.checks import Refused, shown
from mvrecon.data.projections.stack import ProjectionStack

#: Attributes in proportion to light by what of an exposure they measure: its time, the rate of the
#: beam, both ("whole"), or the "share" of these that passes an attenuator. Of those that are
#: "vague" a file does not say which: a monitor may measure a rate or a sum, and frames may be
#: summed in the exposure time, beside it, or averaged.
DICOM = {
    **dict.fromkeys(("ExposureTime", "ExposureTimeInuS", "ExposureTimeInms"), "time"),
    **dict.fromkeys(("XRayTubeCurrent", "XRayTubeCurrentInuA", "XRayTubeCurrentInmA"), "rate"),
    **dict.fromkeys(("Exposure", "ExposureInuAs", "ExposureInmAs", "MetersetExposure"), "whole"),
    **dict.fromkeys(("EntranceDose", "EntranceDoseInmGy"), "whole"),
    **dict.fromkeys(
        ("AveragePulseWidth", "InternalDetectorFrameTime", "NumberOfFramesIntegrated"), "vague"
    ),
    **dict.fromkeys(("FrameAcquisitionDuration", "RelativeXRayExposure"), "vague"),
}
#: In the header of a TIFF of Dectris, beside its time.
DECTRIS = {"Filter_transmission": "share"}
#: Among the counters of an EDF, the current of the ESRF's storage ring.
EDF = {"srcur": "rate"}
#: In a .xim, .hnd or .hnc of Varian, the reading of the chamber behind the tube.
VARIAN = {"KVNormChamber": "vague", "dCTNormChamber": "vague"}
#: In an entry of NeXus, and in its detector.
MONITORS = {
    "control/data": "vague",
    "control/integral": "vague",
    "instrument/beam/incident_flux": "rate",
    "instrument/source/current": "rate",
}
DETECTOR = {
    "count_time": "time",
    "exposure_time": "time",
    "frame_time": "vague",
    "real_time": "vague",
    "number_of_cycles": "vague",
}
#: The time of views in Data Exchange, among them.
EXCHANGE = "exposure_time"
#: Of each attenuator in an instrument of NeXus, behind the path of its group.
ATTENUATOR = "attenuator_transmission"
KINDS = {**DICOM, **DECTRIS, **EDF, **VARIAN, **MONITORS, **DETECTOR}
NAME = "|".join([*map(re.escape, KINDS), rf"[\w./-]+/{ATTENUATOR}"])
#: One of these names, or several joined by `*`, in the place of a path.
EXPOSURE_WORDS = re.compile(rf" *({NAME})( *[*] *({NAME}))* *")
#: Attributes of one quantity, by their units.
UNITS = (
    {"ExposureTime": 1.0, "ExposureTimeInms": 1.0, "ExposureTimeInuS": 1e-3},
    {"XRayTubeCurrent": 1.0, "XRayTubeCurrentInmA": 1.0, "XRayTubeCurrentInuA": 1e-3},
    {"Exposure": 1.0, "ExposureInmAs": 1.0, "ExposureInuAs": 1e-3},
    {"EntranceDoseInmGy": 1.0, "EntranceDose": 100.0},
)
#: Attributes that DICOM rounds to whole ms, mA, mAs and dGy.
ROUNDED = ("ExposureTime", "XRayTubeCurrent", "Exposure", "EntranceDose")
#: Prefixes of units, and the units of exposure times in s and of a beam's current in A; without one
#: they are these.
PREFIXES = {"": 1.0, "m": 1e-3, "u": 1e-6, "µ": 1e-6, "μ": 1e-6, "n": 1e-9}
PREFIXES |= {"milli": 1e-3, "micro": 1e-6, "nano": 1e-9}
SECONDS, AMPERES = (
    {"": 1.0, **{start + name: part for start, part in PREFIXES.items() for name in names}}
    for names in (
        ("s", "sec", "secs", "second", "seconds", "second(s)"),
        ("a", "amp", "ampere", "amperes"),
    )
)
SECONDS |= dict.fromkeys(("min", "minute", "minutes"), 60.0)
SECONDS |= dict.fromkeys(("h", "hour", "hours"), 3600.0)
#: Relative difference of exposures, and of numbers of the beam, that counts.
MAX_CHANGE, MAX_BEAM_CHANGE = 0.01, 1e-3
#: A number as text, with its unit.
NUMBER = re.compile(r"([-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)\s*(\D*)")


def kind_of(name: str) -> str:
    """What an attribute measures of an exposure; "beam" of others, to which light is not in
    proportion.
    """
    return "share" if name.endswith(f"/{ATTENUATOR}") else KINDS.get(name, "beam")


def in_base_units(values: np.ndarray, name: str, unit: str, where: object) -> np.ndarray:
    """Times in s and currents in A; other attributes as they are.

    Args:
        values: values of an attribute.
        name: name of the attribute.
        unit: unit that the file states; "" of none.
        where: file and place of the values, for the message.

    Warns:
        UserWarning: an unknown unit; the values are NaN.
    """
    last = name.rpartition("/")[2].lower()
    known = SECONDS if "time" in last else AMPERES if "current" in last else None
    factor = 1.0 if known is None else known.get(unit.strip().lower(), np.nan)
    if np.isnan(factor):
        such = "s or ms" if known is SECONDS else "A or mA"
        warnings.warn(
            f"{where}: expected the {name} in units such as {such}, got {shown(unit)}; it is not "
            f"used",
            stacklevel=3,
        )
    return values * factor


@contextmanager
def unneeded(cure: str = "") -> Iterator[None]:
    """Warn of what is refused within, instead of raising, as the views do not need it."""
    try:
        yield
    except Refused as error:
        warnings.warn(f"{error}; it is not used{cure}", stacklevel=4)


def number_of(text: object, where: str) -> float | None:
    """A finite number that the views do not need; None of other texts, with a warning.

    Args:
        text: text or number in a file.
        where: file and name of the number, for the message.
    """
    with unneeded():
        try:
            value = float(str(text))
        except ValueError:
            value = math.nan
        if not math.isfinite(value):
            raise Refused(f"{where}: expected a number, got {shown(text)}")
        return value
    return None


def named(exposure: str | Path) -> list[str]:
    """The attributes that are joined by `*` in an option; empty if it is a file, or others."""
    names = [name.strip() for name in str(exposure).split("*")]
    known = all(kind_of(name) != "beam" for name in names)
    return names if known and not Path(exposure).expanduser().exists() else []


def exposure_names(views: ProjectionStack, exposure: str | Path | None) -> list[str]:
    """The attributes that an option `exposure` names; empty if views do not all state them."""
    names = [] if exposure is None else named(exposure)
    return names if names and views.exposure(*names) is not None else []


def _values_of(texts: Iterable[str]) -> set[str]:
    """The values of an attribute in texts of views; "" of none, several joined by " or "."""
    return {word for text in texts for word in text.split(" or ")} - {""}


def warn_of_several(path: Path, stated: Mapping[str, Sequence[str]], cure: str = "") -> None:
    """Warn, once, of views that state several values of an attribute, but for numbers that differ
    by no more than counts.

    Args:
        path: path of the views.
        stated: text of each view by the name of the attribute; "" of none, several joined by
            " or ".
        cure: advice that ends the warning; "": that for exposure and beam.
    """
    several, names = [], []
    for name, texts in stated.items():
        words = _values_of(texts)
        within = 0.0 if cure else _counting(name)  # others are places: every difference counts
        numbers = _numbers(words)
        apart = (np.ptp(x, axis=0) > within * np.abs(x).max(axis=0) for x in numbers.values())
        if len(numbers) > 1 or any(differ.any() for differ in apart):
            several.append(f"{name}, {' or '.join(sorted(words)[:3])}")
            names += [] if kind_of(name) == "beam" else [name]
    if several:
        first = {kind_of(name): name for name in reversed(names)}
        kinds = ("whole", "share") if "whole" in first else ("time", "rate", "share")
        way = "*".join(first[kind] for kind in kinds if kind in first) or first.get("vague")
        cure = cure or (
            f"for which their grey values are not corrected but by views.exposure="
            f"{f'{way} or ' if way else ''}<file> with exposures relative to the flat field's"
        )
        warnings.warn(
            f"{path}: views have several values of {'; '.join(several)}, {cure}", stacklevel=3
        )


def _numbers(words: Iterable[str]) -> dict[tuple[str, ...], np.ndarray]:
    """The numbers of words, a row for each word, by their units or other texts; order and case of
    these do not count.
    """
    rows: dict[tuple[str, ...], list[list[float]]] = {}
    for word in words:
        parts = sorted(map(_quantity, word.strip("[]()").split(",")))
        rows.setdefault(tuple(unit for unit, _ in parts), []).append([x for _, x in parts])
    return {units: np.array(own) for units, own in rows.items()}


def _quantity(text: str) -> tuple[str, float]:
    """The unit of a number, and the number; another text, and 0."""
    if (number := NUMBER.fullmatch(text.strip(" '\""))) is None:
        return text.strip(" '\"").casefold(), 0.0
    unit = number[2].strip()
    start = "M" if unit[:1] == "M" else ""  # mega, not milli
    return start + unit[len(start) :].casefold(), float(number[1])


def _counting(name: str) -> float:
    """The relative difference of an attribute's numbers from which on it counts."""
    if kind_of(name) != "beam":
        return MAX_CHANGE
    return 0.0 if name.endswith("ID") else MAX_BEAM_CHANGE


def _same_beam(name: str, own: set[str], other: set[str]) -> bool:
    """Whether each word of either is one of the other, or as near to it as does not count."""
    a, b = _numbers(own), _numbers(other)
    return a.keys() == b.keys() and all(
        np.isclose(near, row, rtol=_counting(name), atol=0).all(axis=1).any()
        for units in a
        for rows, near in ((a[units], b[units]), (b[units], a[units]))
        for row in rows
    )


def relative_exposure(
    views: ProjectionStack, flat: ProjectionStack | float | None, names: Sequence[str]
) -> Float[np.ndarray, " m"]:
    """The product of attributes of each view, relative to the mean of the flat field's.

    Raises:
        Refused: the flat field does not state it, or others contradict it.
    """
    values = _relative(views, flat, names)
    if values is None or not isinstance(flat, ProjectionStack):
        raise Refused(
            f"{views.path}: expected a positive {'*'.join(names)} of the flat field and of each "
            f"view, got others, or none; views.exposure=<file> states those of views relative to it"
        )
    for others, constant in _others(views, flat, names):
        if (other := _relative(views, flat, others)) is None:
            continue
        used = {*names, *others}
        sources = [(views, name) for name in used]
        sources += [(flat, found[0]) for name in used if (found := _stated_as(flat, name))]
        rounded = (stack.exposure(name) for stack, name in sources if name in ROUNDED)
        rounding = sum(0.5 / stated.min() for stated in rounded if stated is not None)
        off = [np.abs(other / expected - 1).max() for expected in (values, 1.0)[: 1 + constant]]
        if min(off) > MAX_CHANGE + rounding:
            cure = "*".join((*names, *others) if constant else others)
            raise Refused(
                f"{views.path}: expected {'*'.join(others)} to change as {'*'.join(names)} "
                f"between the flat field and its views, by {_words(values)}, got {_words(other)}; "
                f"say views.exposure={cure} if light is in proportion to that, or give a <file> "
                f"with exposures relative to the flat field's"
            )
    return values


def _relative(
    views: ProjectionStack, flat: ProjectionStack | float | None, names: Sequence[str]
) -> Float[np.ndarray, " m"] | None:
    """The ratio of a product of attributes to the flat field's; None unless both state it."""
    own = views.exposure(*names)
    if own is None or not isinstance(flat, ProjectionStack):
        return None
    others = [stated for name in names if (stated := _of(flat, name)) is not None]
    if len(others) < len(names):
        return None
    other = np.prod(others, axis=0)
    return own / other.mean() if min(own.min(), other.min()) > 0 else None


def _of(field: ProjectionStack, name: str) -> Float[np.ndarray, " m"] | None:
    """An attribute of a field, also if it is stated in another unit; None if it is not stated."""
    found = _stated_as(field, name)
    values = None if found is None else field.exposure(found[0])
    return None if found is None or values is None else values * found[1]


def _stated_as(field: ProjectionStack, name: str) -> tuple[str, float] | None:
    """The name by which a field states an attribute, in its own unit or another, and the factor to
    its own unit; None if it does not.
    """
    units = next((units for units in UNITS if name in units), {name: 1.0})
    names = (other for other in (name, *units) if field.exposure(other) is not None)
    return next(((other, units[other] / units[name]) for other in names), None)


def _others(
    views: ProjectionStack, flat: ProjectionStack, names: Sequence[str]
) -> Iterator[tuple[tuple[str, ...], bool]]:
    """Products of attributes that must change as that of `names`, and whether they may be constant
    instead.
    """
    stated = [
        name
        for name in views.stated
        if kind_of(name) != "beam" and _relative(views, flat, [name]) is not None
    ]
    kinds = {kind_of(name) for name in names}
    for name in stated:
        if name not in names and "vague" in (kind_of(name), *kinds):
            yield (name,), True
    if "vague" in kinds:
        return
    times, rates, whole = (
        [(name,) for name in stated if kind_of(name) == kind] for kind in ("time", "rate", "whole")
    )
    shares = tuple(name for name in stated if kind_of(name) == "share")
    yield from ((product + shares, False) for product in whole)
    if "whole" not in kinds:  # what is not stated is taken to be constant
        times, rates = times or [()], rates or [()]
    yield from ((time + rate + shares, False) for time in times for rate in rates)


def _words(values: np.ndarray | None) -> str:
    ends = [f"{end:.4g}" for end in (() if values is None else (values.min(), values.max()))]
    return " to ".join(dict.fromkeys(ends))


def warn_of_others(
    views: ProjectionStack, field: ProjectionStack, name: str, applied: Sequence[str] = ()
) -> None:
    """Warn of a field that was taken with another exposure, or in another beam, than its views.

    Args:
        views: the views as they are stored.
        field: their dark or flat field.
        name: "flat", or "dark", for which only times count.
        applied: attributes that `relative_exposure` applies, and to which it compares others.
    """
    for key, texts in views.stated.items():
        kind = kind_of(key)
        if (name == "dark" and kind != "time") or (name == "flat" and applied and kind != "beam"):
            continue
        if kind == "beam":
            sets = [_values_of(one) for one in (texts, field.stated.get(key, ()))]
            own, other = (" or ".join(sorted(one)[:3]) for one in sets)
            same = not own or not other or _same_beam(key, *sets)
        else:
            ratio = _relative(views, field, [key])
            same = ratio is None or np.abs(ratio - 1).max() <= MAX_CHANGE
            own, other = map(_words, (views.exposure(key), _of(field, key)))
        if same:
            continue
        cure = f" but by views.exposure={key}, or <file>" if kind != "beam" else ""
        warnings.warn(
            f"{field.path}: the {name} field has the {key} {other}, its views have {own}, for "
            f"which their grey values are not corrected{cure if name == 'flat' else ''}",
            stacklevel=2,
        )
