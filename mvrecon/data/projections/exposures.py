"""What files state of the exposure and the beam of views and of their fields: compared, and applied
by name.
"""

import warnings
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float

from mvrecon.core.files.checks import Refused
from mvrecon.data.projections.stack import ProjectionStack

#: Attributes in proportion to light by what of an exposure they measure: its time, the rate of the
#: beam, or both ("whole"). Of those that are "vague" a file does not say which: a monitor may
#: measure a rate or a sum, and frames may be summed in the exposure time, beside it, or averaged.
DICOM = {
    **dict.fromkeys(("ExposureTime", "ExposureTimeInuS", "ExposureTimeInms"), "time"),
    **dict.fromkeys(("XRayTubeCurrent", "XRayTubeCurrentInuA", "XRayTubeCurrentInmA"), "rate"),
    **dict.fromkeys(("Exposure", "ExposureInuAs", "ExposureInmAs", "MetersetExposure"), "whole"),
    **dict.fromkeys(
        ("AveragePulseWidth", "InternalDetectorFrameTime", "NumberOfFramesIntegrated"), "vague"
    ),
}
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
    "number_of_cycles": "vague",
}
#: The time of views in Data Exchange, among them.
EXCHANGE = "exposure_time"
KINDS = {**DICOM, **MONITORS, **DETECTOR}
#: Attributes of one quantity, by their units.
UNITS = (
    {"ExposureTime": 1.0, "ExposureTimeInms": 1.0, "ExposureTimeInuS": 1e-3},
    {"XRayTubeCurrent": 1.0, "XRayTubeCurrentInmA": 1.0, "XRayTubeCurrentInuA": 1e-3},
    {"Exposure": 1.0, "ExposureInmAs": 1.0, "ExposureInuAs": 1e-3},
)
#: Attributes that DICOM rounds to whole ms, mA and mAs.
ROUNDED = ("ExposureTime", "XRayTubeCurrent", "Exposure")
#: Relative difference of exposures, or of the beam, that counts.
MAX_CHANGE = 0.01


def exposure_names(views: ProjectionStack, exposure: str | Path | None) -> list[str]:
    """The attributes of views that are joined by `*` in an option; empty if it is a file, or if
    views do not all state them.
    """
    names = str(exposure).split("*")
    if exposure is None or Path(exposure).expanduser().exists() or not {*names} <= {*KINDS}:
        return []
    return [] if views.exposure(*names) is None else names


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
    """What a field states by a name, or in another unit; None if it does not."""
    found = _stated_as(field, name)
    values = None if found is None else field.exposure(found[0])
    return None if found is None or values is None else values * found[1]


def _stated_as(field: ProjectionStack, name: str) -> tuple[str, float] | None:
    """By what name a field states an attribute, in its own unit or another, and the factor to its
    own; None if it does not.
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
    stated = [name for name in KINDS if _relative(views, flat, [name]) is not None]
    kinds = {KINDS[name] for name in names}
    for name in stated:
        if name not in names and "vague" in (KINDS[name], *kinds):
            yield (name,), True
    if "vague" in kinds:
        return
    times, rates, whole = (
        [(name,) for name in stated if KINDS[name] == kind] for kind in ("time", "rate", "whole")
    )
    yield from ((product, False) for product in whole)
    if "whole" not in kinds:  # what is not stated is taken to be constant
        times, rates = times or [()], rates or [()]
    yield from ((time + rate, False) for time in times for rate in rates)


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
        kind = KINDS.get(key, "beam")
        if (name == "dark" and kind != "time") or (name == "flat" and applied and kind != "beam"):
            continue
        if kind == "beam":
            sets = ({*one} - {""} for one in (texts, field.stated.get(key, ())))
            own, other = (" or ".join(sorted(one)[:3]) for one in sets)
            same = not own or not other or own == other
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
