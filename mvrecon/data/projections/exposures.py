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
    "instrument/beam/incident_flux": "rate",
    "instrument/source/current": "rate",
}
DETECTOR = {"count_time": "time", "number_of_cycles": "vague"}
#: Of Data Exchange.
EXCHANGE = "exposure_time"
KINDS = {**DICOM, **MONITORS, **DETECTOR, EXCHANGE: "time"}
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
        rounding = sum(
            0.5 / stack.exposure(name).min()  # type: ignore[union-attr]
            for name in {*names, *others} & {*ROUNDED}
            for stack in (views, flat)
        )
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
    stacks = (views, flat)
    own, other = (s.exposure(*names) if isinstance(s, ProjectionStack) else None for s in stacks)
    if own is None or other is None or min(own.min(), other.min()) <= 0:
        return None
    return own / other.mean()


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


def _words(values: np.ndarray) -> str:
    ends = [f"{end:.4g}" for end in (values.min(), values.max())]
    return " to ".join(dict.fromkeys(ends))


def warn_of_others(
    views: ProjectionStack, field: ProjectionStack, name: str, applied: Sequence[str] = ()
) -> None:
    """Warn of a field that was taken with another exposure, or in another beam, than its views.

    Args:
        views: as they are stored.
        field: of theirs.
        name: "flat", or "dark", for which only times count.
        applied: attributes that `relative_exposure` applies, and to which it compares others.
    """
    for key, texts in views.stated.items():
        own, other = ({*one} - {""} for one in (texts, field.stated.get(key, ())))
        kind = KINDS.get(key, "beam")
        if not own or not other or (name == "dark" and kind != "time"):
            continue
        if kind != "beam":
            ratio = _relative(views, field, [key])
            if ratio is None or np.abs(ratio - 1).max() <= MAX_CHANGE:
                continue
        if own == other or (name == "flat" and applied and kind != "beam"):
            continue
        pair = []
        for stack, words in ((field, other), (views, own)):
            numbers = stack.exposure(key) if kind != "beam" else None
            pair.append(" or ".join(sorted(words)[:3]) if numbers is None else _words(numbers))
        cure = f" but by views.exposure={key}, or <file>" if kind != "beam" else ""
        warnings.warn(
            f"{field.path}: the {name} field has the {key} {pair[0]}, its views have {pair[1]}, "
            f"for which their grey values are not corrected{cure if name == 'flat' else ''}",
            stacklevel=2,
        )
