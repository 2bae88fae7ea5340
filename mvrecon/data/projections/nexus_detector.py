"""What a detector of NeXus states beside its frames: their kinds and order, exposures, bad pixels
and greatest grey value (Könnecke and others, J. Appl. Cryst. 48, 2015).
"""

import math
import re
import warnings
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np

from mvrecon.core.files.checks import Refused, shown
from mvrecon.core.files.keys import Key
from mvrecon.data.linked import UNITS, MissingFile, Place, followed, members, texts_at, values_at
from mvrecon.data.projections import exposures
from mvrecon.data.projections.exposures import unneeded
from mvrecon.data.projections.frames import Frames
from mvrecon.data.storage import check_chunks, dataset_in, opened

#: Frames of views, flat and dark fields by their image_key; others are left out.
VIEW, FLAT, DARK, INVALID, ALIGNMENT = 0, 1, 2, 3, -1
#: Data sets of a detector of NeXus, and of an entry, on which grey values depend in a way that is
#: not stated.
DETECTOR_BEAM = (
    *("gain_setting", "threshold_energy", "flatfield_applied", "pixel_mask_applied"),
    *("countrate_correction_applied", "angular_calibration_applied"),
    "virtual_pixel_interpolation_applied",
)
BEAM = (
    *("beam/incident_energy", "beam/incident_wavelength"),
    *("instrument/beam/incident_energy", "instrument/beam/incident_wavelength"),
    *("instrument/monochromator/energy", "instrument/source/voltage"),
)
#: Data sets of each pixel and of each frame of a detector, and single numbers.
LIMITS = ("pixel_mask", "sequence_number")
NUMBERS = ("saturation_value", "underload_value")
#: The type of numbers.
NUMERIC = re.compile(r"(u?int|float|bool)\d*")
KEYS = (
    Key("pixel_mask", "applied", "bad pixels, all but 0; another size is warned of"),
    Key("saturation_value", "applied", "the greatest grey value, where positive"),
    Key("bit_depth_readout", "ignored", "of the readout: images that sum several hold more"),
    Key("underload_value", "compared", "with 0; warned of"),
    Key(
        "sequence_number",
        "compared",
        "with the order of the views, also where it starts again at 0; gaps are warned of",
    ),
)


def there(path: Path, name: str) -> Place | None:
    """An optional data set; None also if it is in another file, which is missing."""
    try:
        return followed(path, name)
    except MissingFile:
        return None


def first(
    groups: Sequence[Place],
    *names: str,
    find: Callable[[Path, str], Place | None] = followed,
) -> Place | None:
    """The first data set of any of these names in groups, the names in their order."""
    for name in names:
        for path, group, _ in groups:
            if (place := find(path, f"{group}/{name}")) is not None:
                return place
    return None


def of_frames(name: str, place: Place, keys: np.ndarray, unit: str) -> np.ndarray:
    """An attribute of each frame as text, an exposure in s or A or a property of the beam; "" where
    it is not stated. The file has one value for all, one for each frame, or one for each view.

    Warns:
        UserWarning: no numbers of an exposure, another number of them, or a time or current of an
            unknown unit; views that differ where flat fields state none.
    """
    stated, views = np.full(len(keys), "", object), keys == VIEW
    texts: list[str] = []
    with unneeded():
        texts = _texts_of(name, place, unit)
        if len(texts) not in (1, len(keys), views.sum()):
            raise Refused(
                f"{place}: expected one {name}, or one of each of {len(keys)} frames or "
                f"{views.sum()} views, got {len(texts)}"
            )
        stated[views if len(texts) == views.sum() else slice(None)] = texts
    if exposures.kind_of(name) == "beam":
        exposures.warn_of_several(place.path, {name: stated[views]})
        return stated
    own, flats = (np.array([float(t) for t in stated[w] if t]) for w in (views, keys == FLAT))
    changes = len(own) and np.ptp(own) > exposures.MAX_CHANGE * abs(own.mean())
    if changes and not (len(flats) and (flats > 0).all()):
        warnings.warn(
            f"{place.path}: {name}: of the views is {own.min():.4g} to {own.max():.4g}, which "
            f"is not corrected unless views.exposure=<file> states it",
            stacklevel=2,
        )
    return stated


def _texts_of(name: str, place: Place, unit: str) -> list[str]:
    """The values of a data set as texts; "" of those that are not finite, or of an unknown unit.

    Raises:
        Refused: an exposure that is no number, or many texts.
    """
    text = texts_at([place], "").get(place, "").strip()  # or the type of numbers
    beam, number = exposures.kind_of(name) == "beam", exposures.NUMBER.fullmatch(text)
    if beam and not NUMERIC.fullmatch(text):
        if re.fullmatch(r"object|\|S\d+", text):  # texts of each frame
            raise Refused(f"{place}: expected one {name} of all frames, got many texts")
        return [text]
    if number:
        values, unit = np.array([float(number[1])]), number[2] or unit
    else:
        values = values_at(place, UNITS).ravel().astype(float)
    if not beam:
        values = exposures.in_base_units(values, name, unit, place)
    end = f" {unit}".rstrip() if beam else ""
    return [f"{x:.12g}{end}" if np.isfinite(x) else "" for x in values]


def kinds_in(groups: Sequence[Place]) -> dict[Place, str]:
    """The members of groups that are groups of NeXus, also by links, with their classes."""
    found = [
        there(group.path, f"{group.name}/{name}") for group in groups for name in members(group)
    ]
    return texts_at([place for place in found if place is not None], "NX_class")


def limits_in(groups: Sequence[Place]) -> dict[str, Place]:
    """What `limits_of` reads in groups, such as that of the detector, by name."""
    found = {name: first(groups, name, find=there) for name in (*LIMITS, *NUMBERS)}
    return {name: place for name, place in found.items() if place is not None}


def limits_of(
    places: Mapping[str, Place], frames: Frames, keys: np.ndarray
) -> tuple[np.ndarray | None, float | None]:
    """Pixels that the detector's mask marks as bad, and its greatest grey value; None of what
    it does not state. Compares the order of the frames.

    Args:
        places: data sets beside the frames, see `limits_in`.
        frames: all frames of the file.
        keys: image_key of each frame.

    Warns:
        UserWarning: a mask of another size, other values than one number, an underload.
    """
    if (place := places.get("sequence_number")) is not None:
        _check_sequence(place, keys)
    numbers = {name: _number(places[name]) for name in NUMBERS if name in places}
    if numbers.get("underload_value", 0) > 0:
        place = places["underload_value"]
        warnings.warn(f"{place}: is not applied: values below it are wrong", stacklevel=2)
    top, place = numbers.get("saturation_value", 0.0), places.get("pixel_mask")
    return None if place is None else _mask(place, frames.shape[1:]), top if top > 0 else None


def _number(place: Place) -> float:
    """A number of a detector; 0 of another one, with a warning."""
    with unneeded():
        values = values_at(place, UNITS).ravel().astype(float)
        if len(values) != 1 or not np.isfinite(values[0]):
            raise Refused(f"{place}: expected one number, got {shown(values.tolist())}")
        return float(values[0])
    return 0.0


def _mask(place: Place, shape: tuple[int, ...]) -> np.ndarray | None:
    """Bad pixels by a detector's mask [v u]; None of another one, with a warning."""
    with unneeded("; give it as views.bad_pixels"), opened(place.path) as file:
        stored = dataset_in(place.path, file, place.name)
        if stored.dtype.kind not in "biu" or (*stored.shape[-2:], stored.size) != (
            *shape,
            math.prod(shape),
        ):
            got = f"{stored.dtype} {stored.shape}"
            raise Refused(f"{place}: expected a mask of {shape} pixels, got {got}")
        check_chunks(place.path, stored)
        return stored[()].reshape(shape) != 0
    return None


def _check_sequence(place: Place, keys: np.ndarray) -> None:
    """Compare the sequence numbers of frames, counted for all or for each kind, with their order.

    Warns:
        UserWarning: frames between views are missing, no numbers, or another number of them.

    Raises:
        Refused: views are not in the order of their numbers.
    """
    own, views = np.zeros(0), np.flatnonzero(keys == VIEW)
    with unneeded():
        numbers = values_at(place, UNITS).ravel()
        if len(numbers) not in (len(keys), len(views)):
            raise Refused(
                f"{place}: expected a number of each of {len(keys)} frames or {len(views)} views, "
                f"got {len(numbers)}"
            )
        chosen = numbers[views] if len(numbers) == len(keys) else numbers
        if not np.isfinite(chosen).all():
            raise Refused(f"{place}: expected a number of each view, got {shown(chosen.tolist())}")
        own = chosen
    if not (own != own[:1]).any():  # never filled
        return
    apart = np.diff(views)
    steps = np.diff(own if own.dtype.kind == "u" else own.astype(float))
    if own.dtype.kind == "u":  # counters start again at 0; from half a turn on it is a step back
        one_each = steps == apart.astype(own.dtype)
        steps = np.where(one_each, apart, steps.astype(f"i{own.dtype.itemsize}"))
    if (steps <= 0).any():
        first = int(np.argmax(steps <= 0))
        raise Refused(
            f"{place}: expected views in the order of their sequence numbers, got "
            f"{own[first]:g} and then {own[first + 1]:g}; sort frames and angles by them"
        )
    least = (steps[apart == 1] if (apart == 1).any() else steps).min()
    if (gaps := (steps != least) & (steps != least * apart)).any():
        first = int(np.argmax(gaps))
        warnings.warn(
            f"{place}: {gaps.sum()} gaps between views, such as from {own[first]:g} to "
            f"{own[first + 1]:g}: frames were dropped, and angles must be those of the others",
            stacklevel=2,
        )
