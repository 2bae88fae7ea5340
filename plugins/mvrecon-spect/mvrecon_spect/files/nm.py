"""DICOM NM: frames sorted by their vectors, with energy windows, angles and radii; gated and
dynamic studies frame by frame. Requires pydicom.

PS3.3, C.8.4: a frame's entries in the vectors EnergyWindowVector, DetectorVector, RotationVector
and AngularViewVector identify it; frames may be in any order. Angles are zero at the patient's back
and increase towards the patient's left (counter-clockwise, viewed from the feet).
"""

from collections.abc import Iterator, Sequence
from datetime import datetime
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from mvrecon.core.files.checks import Refused, file_errors, shown
from mvrecon.data.dicom_image import DicomImage, same
from mvrecon.data.dicom_pixels import pixels_of
from mvrecon.geometry.cameras.camera import Cameras
from mvrecon_spect.files.nm_keys import (
    DESCRIBED,
    DURATION,
    TIME,
    VIEW,
    WINDOW,
    check_alike,
    check_counts,
)

Moment = tuple[int, int, int, int]


class View(NamedTuple):
    """Identity of a view: detector, rotation and number in the rotation, from 1; angle in degrees,
    distance of the detector from the axis in mm and duration in s, each None if the file
    does not contain it. The duration of a dynamic frame is that of its phase; that of a gated one,
    a part of each cycle, is unknown.
    """

    detector: int
    rotation: int
    number: int
    angle_degrees: float | None
    radius_mm: float | None
    duration_s: float | None


class Frame(NamedTuple):
    """Time of a frame of a dynamic or gated study: phase and time slice, R-R interval and time
    slot, each from 1; start and duration in s from the beginning of the study or from the R wave,
    None if the file does not contain them, or frames backward from the R wave.
    """

    phase: int
    time_slice: int
    rr_interval: int
    time_slot: int
    start_s: float | None
    duration_s: float | None


class EnergyWindow(NamedTuple):
    """An energy window: its name, and the lower and upper limits of its ranges in keV."""

    name: str
    limits_kev: tuple[tuple[float, float], ...]


class NmStudy(NamedTuple):
    """Counts of a DICOM NM file for each energy window [1 1 m v u], with the identity of the m
    views, the pixel size (v, u) in mm, and when the acquisition began, None if the file does not
    contain it.
    """

    windows: tuple[EnergyWindow, ...]
    counts: tuple[Float[Tensor, "1 1 m v u"], ...]
    views: tuple[View, ...]
    pixel_mm: tuple[float, float]
    began: datetime | None = None


def read_nm(path: str | Path) -> NmStudy:
    """Read the counts of a DICOM NM file, sorted by detector, rotation and angular view.

    Raises:
        ImportError: pydicom is not installed.
        Refused: gated or dynamic frames, which require `read_frames`; see `read_frames`.
    """
    frames = list(read_frames(path))
    if len(frames) > 1:
        raise Refused(
            f"{path}: expected one frame in time, got a gated or dynamic study of {len(frames)}; "
            f"read_frames reads them one by one"
        )
    return frames[0][1]


def read_frames(path: str | Path) -> Iterator[tuple[Frame, NmStudy]]:
    """Read the counts of a dynamic or gated DICOM NM file frame by frame in temporal order, each
    sorted by detector, rotation and angular view.

    A file with one time frame, such as a tomogram, returns one.

    Raises:
        ImportError: pydicom is not installed.
        Refused: a wrong modality, reconstructed slices, vectors inconsistent with the frames,
            frames or windows whose views differ from those of the first, detectors whose start
            angles are unknown, negative counts, another unit, or corrections that counts do not
            have.
    """
    path = Path(path).expanduser()
    image = DicomImage(path)
    count = image.frames
    if len(set(frame_numbers(image, "SliceVector"))) > 1:
        raise Refused(f"{path}: expected measured views, got the slices of a volume")
    check_counts(image)
    phase, piece, interval, slot, window, *place = (
        frame_numbers(image, name) for name in (*TIME, WINDOW, *VIEW)
    )
    _check_numbered(image)
    check_alike(image)
    times = list(zip(phase, piece, interval, slot, strict=True))
    places = list(zip(*place, strict=True))
    order = {key: n for n, key in enumerate(zip(times, window, places, strict=True))}
    moments, windows, known = sorted(set(times)), sorted(set(window)), sorted(set(places))
    if len(order) != count or count != len(moments) * len(windows) * len(known):
        raise Refused(
            f"{path}: expected every view once in every frame in time and every energy window, got "
            f"{count} images of {len(moments)} frames, {len(windows)} windows and {len(known)} "
            f"views, {len(order)} of them different"
        )
    pixels = torch.from_numpy(pixels_of(path)).reshape(count, *image.shape)
    if not (pixels >= 0).all():
        raise Refused(f"{path}: expected counts, not negative, got {pixels.min().item():g}")
    if (pixel_mm := image.pixel_mm("PixelSpacing")) is None:
        raise Refused(f"{path}: expected PixelSpacing in mm, got none")
    with file_errors(path, "describes its windows, detectors, rotations or phases wrongly"):
        named = (*DESCRIBED.values(), "GatedInformationSequence", DURATION)
        dataset = {name: image.value(name) for name in named}
        _check_starts(path, dataset, known)
        _check_rotations(path, dataset, known)
        _check_stated(path, dataset, known)
        views = tuple(_view(dataset, key, known) for key in known)
        energies = tuple(_window(dataset, index) for index in windows)
        frames = [_frame(dataset, moment, moments) for moment in moments]
        start = began(image.dataset)
    phases = any(_seconds(item) for item in dataset["PhaseInformationSequence"] or ())
    gated = dataset["GatedInformationSequence"] or len({moment[2:] for moment in moments}) > 1

    def study(frame: Frame) -> NmStudy:
        chosen = ([order[frame[:4], index, key] for key in known] for index in windows)
        counts = tuple(pixels[images][None, None] for images in chosen)
        own = {"duration_s": None if gated else frame.duration_s}
        timed = tuple(view._replace(**own) for view in views) if gated or phases else views
        return NmStudy(energies, counts, timed, pixel_mm, start)

    return ((frame, study(frame)) for frame in frames)


def paired(study: NmStudy, cameras: Cameras | None) -> Cameras:
    """Check that a rig of pinholes matches a study, with one camera per view, and return it.

    Raises:
        ValueError: no rig, or a wrong number of cameras, detector size or pixel size.
    """
    if cameras is None:
        raise ValueError(
            "Expected a rig of pinholes for the views of DICOM NM, got none: the format does not "
            "say where pinholes are; give a camera file (camera=from_file, or matrices)"
        )
    count, shape = len(study.views), tuple(study.counts[0].shape[-2:])
    steps = torch.stack([cameras.v.norm(dim=-1), cameras.u.norm(dim=-1)], dim=-1)
    off = (steps / steps.new_tensor(study.pixel_mm) - 1).abs().max().item()
    if len(cameras) != count or cameras.shape != shape or off > 1e-3:
        raise ValueError(
            f"Expected {count} cameras of {shape} pixels of {study.pixel_mm} mm, as the NM file "
            f"has them, got {len(cameras)} of {cameras.shape} and {tuple(steps[0].tolist())} mm"
        )
    return cameras


def frame_numbers(image: DicomImage, name: str) -> list[int]:
    """The number of each frame in a vector of a file, from 1; ones if it has none."""
    frames = image.frames
    if (value := image.value(name)) is None:
        return [1] * frames
    with file_errors(image.path, f"has a {name} that cannot be read"):
        values = [int(v) for v in np.atleast_1d(value)]
    if len(values) != frames or min(values) < 1:
        raise Refused(
            f"{image.path}: expected {name} of {frames} numbers from 1 on, one per frame, got "
            f"{len(values)}"
        )
    return values


def _check_numbered(image: DicomImage) -> None:
    """Raise if the items of a sequence differ and no vector assigns the frames to them."""
    for vector, name in DESCRIBED.items():
        items = image.value(name) or []
        if image.value(vector) is None and any(item != items[0] for item in items):
            raise Refused(
                f"{image.path}: expected {vector}, which numbers the {len(items)} items of {name} "
                f"for each frame, got none"
            )
    gates = image.value("GatedInformationSequence") or []
    if any(gate != gates[0] for gate in gates):
        raise Refused(
            f"{image.path}: expected one item of GatedInformationSequence, got {len(gates)} that "
            f"differ; write a file for each"
        )


def began(dataset: Any) -> datetime | None:
    """Start of the acquisition, without a time zone."""
    text = str(dataset.get("AcquisitionDateTime") or "")
    if not text and dataset.get("AcquisitionDate") and dataset.get("AcquisitionTime"):
        text = f"{dataset.AcquisitionDate}{dataset.AcquisitionTime}"
    text, point, fraction = text.partition("+")[0].partition("-")[0].partition(".")
    if len(text) < len("YYYYMMDDHH"):
        return None
    whole = text.ljust(len("YYYYMMDDHHMMSS"), "0")
    return datetime.strptime(whole + point + fraction, "%Y%m%d%H%M%S" + ".%f" * bool(point))


def _window(dataset: Any, index: int) -> EnergyWindow:
    item = _item(dataset, "EnergyWindowInformationSequence", index)
    ranges = item.get("EnergyWindowRangeSequence") or []
    limits = [(float(r.EnergyWindowLowerLimit), float(r.EnergyWindowUpperLimit)) for r in ranges]
    if not all(0 <= low < high for low, high in limits):
        raise ValueError(f"energy windows need lower < upper keV, got {limits}")
    return EnergyWindow(str(item.get("EnergyWindowName") or ""), tuple(limits))


def _check_starts(path: Path, dataset: Any, views: Sequence[tuple[int, int, int]]) -> None:
    """Raise if the file does not say where each of several detectors starts: the rotation alone
    states an angle, or each of several rotations states its own.
    """
    turns = {view[1] for view in views}
    starts = {n: _start(dataset, "RotationInformationSequence", n) for n in sorted(turns)}
    for start in (angle for angle in starts.values() if angle is not None):
        alike = {n for n, a in starts.items() if a is not None and _alike("StartAngle", a, start)}
        detectors = sorted({view[0] for view in views if view[1] in alike})
        own = [_start(dataset, "DetectorInformationSequence", number) for number in detectors]
        if None in own and len(detectors) > 1:
            without = [n for n, angle in zip(detectors, own, strict=True) if angle is None]
            raise Refused(
                f"{path}: expected a StartAngle of each of the {len(detectors)} detectors, got "
                f"none of detector {', '.join(map(str, without))}: by that of the rotation alone, "
                f"{start}, the heads would all have the same angles; set it in "
                f"DetectorInformationSequence"
            )
        elsewhere = {view[0] for view in views if view[1] not in alike}
        only = {angle for n, angle in zip(detectors, own, strict=True) if n not in elsewhere}
        agrees = all(_alike("StartAngle", angle, start) for angle in only - {None})
        if len(turns) > 1 and (len(set(own)) > 1 or not agrees):
            raise Refused(
                f"{path}: expected one rotation of detectors with different StartAngle, got "
                f"{len(turns)} with a StartAngle each, which does not say where each detector "
                f"starts; write a file for each rotation"
            )


def _start(dataset: Any, name: str, index: int) -> float | None:
    """The start angle in an item of a sequence in degrees; None if there is none."""
    return _number("StartAngle", _item(dataset, name, index))


def _check_rotations(path: Path, dataset: Any, views: Sequence[tuple[int, int, int]]) -> None:
    """Raise for rotations whose arcs or views contradict their steps or the vectors."""
    heads = dataset.get("DetectorInformationSequence") or []
    turns = dataset.get("RotationInformationSequence") or []
    for number, turn in enumerate(turns, 1):
        last = max((view[2] for view in views if view[1] == number), default=0)
        step, arc = (_number(name, turn) for name in ("AngularStep", "ScanArc"))
        count = int(_number("NumberOfFramesInRotation", turn) or last)
        if last > count or (step or 0) < 0:
            raise Refused(
                f"{path}: expected AngularViewVector up to NumberOfFramesInRotation {count} and an "
                f"AngularStep not negative, got {last} and {step}"
            )
        known = max(len(heads), len({view[0] for view in views}))  # an arc of all heads together
        arcs = [(k * count - one) * (step or 0) for k in range(1, known + 1) for one in (0, 1)]
        if step and arc and count > 1 and not any(abs(arc - a) <= 0.02 * a for a in arcs):
            raise Refused(
                f"{path}: expected a ScanArc of {' or '.join(f'{a:g}' for a in arcs)} degrees, as "
                f"AngularStep {step:g} and NumberOfFramesInRotation {count} give, got {arc:g}"
            )


def _alike(name: str, one: Any, other: Any) -> bool:
    """Whether two start angles, durations or lists of radii are equal, or a list contains a
    radius.
    """
    if name == DURATION:
        return same(float(one), float(other))
    a, b = (np.atleast_1d(value).astype(float) for value in (one, other))
    if name == "StartAngle":
        return bool(abs((a[0] - b[0] + 180) % 360 - 180) < 0.1)
    if len(a) == len(b):
        return bool((abs(a - b) < 0.1).all())
    return 1 in (len(a), len(b)) and bool((abs(a - b) < 0.1).any())


def _check_stated(path: Path, dataset: Any, views: Sequence[tuple[int, int, int]]) -> None:
    """Raise if two places state start angles, radii or frame durations, but none in common."""
    image, heads = "the image", "DetectorInformationSequence"
    turns, phases = "RotationInformationSequence", "PhaseInformationSequence"
    items = {image: [dataset]} | {key: dataset.get(key) or [] for key in (heads, turns, phases)}
    pairs = [("StartAngle", turns, heads), ("RadialPosition", turns, heads)]
    pairs += [(DURATION, image, turns), (DURATION, image, phases)]
    if len({view[2] for view in views}) > 1:  # else the file may be made from one of a tomogram
        pairs.append((DURATION, turns, phases))
    for name, place, other in pairs:
        unstated = (None, "", 0) if name == DURATION else (None, "")
        own, found = (
            [item.get(name) for item in items[key] if item.get(name) not in unstated]
            for key in (place, other)
        )
        if own and found and not any(_alike(name, a, b) for a in own for b in found):
            raise Refused(
                f"{path}: expected the {name} of {place} in {other}, got {shown(own)} and "
                f"{shown(found)}; keep the one that is meant"
            )


def _view(dataset: Any, key: tuple[int, int, int], views: Sequence[tuple[int, int, int]]) -> View:
    """Identity of a view. With one rotation, each detector has its own start angle and radii; with
    several, each rotation has.
    """
    detector, rotation, number = key
    count = max(view[2] for view in views if view[:2] == key[:2])
    own = _item(dataset, "DetectorInformationSequence", detector)
    turns = {view[1] for view in views}
    turn = _item(dataset, "RotationInformationSequence", rotation)
    count = int(_number("NumberOfFramesInRotation", turn) or count)
    first, second = (own, turn) if len(turns) < 2 else (turn, own)

    def stated(name: str, index: int = 0, most: int = 1) -> float | None:
        value = _number(name, first, index, most)
        return _number(name, second, index, most) if value is None else value

    angle = stated("StartAngle")
    if angle is not None and (step := _number("AngularStep", turn)) is not None:
        if (direction := turn.get("RotationDirection")) not in ("CW", "CC"):
            raise ValueError(f"RotationDirection is CW or CC, got {shown(direction)}")
        angle = (angle + {"CW": -1, "CC": 1}[direction] * step * (number - 1)) % 360
    duration = _seconds(turn) or _seconds(dataset)
    radii = [item.get("RadialPosition") for item in (first, second)]
    if np.size(radii[0]) == 1 < np.size(radii[1]) and _alike("RadialPosition", *radii):
        first, second = second, first  # one radius of the orbit that the other lists
    radius = stated("RadialPosition", number - 1, count)
    return View(*key, angle, radius, duration)


def _frame(dataset: Any, moment: Moment, moments: Sequence[Moment]) -> Frame:
    """Start and duration of a frame, from the preceding phases of dynamic studies or the nominal
    slot time of gated ones; PS3.3, C.8.4.11 and C.8.4.14. Programs leave out a pause or delay of 0.
    """
    phase, piece, interval, slot = moment
    if dataset.get("PhaseInformationSequence"):
        start: float | None = 0.0
        for number in range(1, phase + 1):
            item = _item(dataset, "PhaseInformationSequence", number)
            delay, pause, count = (
                _number(name, item) or 0.0
                for name in ("PhaseDelay", "PauseBetweenFrames", "NumberOfFramesInPhase")
            )
            pieces, duration = {p for n, p, *_ in moments if n == number}, _seconds(item)
            if 0 < count < len(pieces):
                raise ValueError(f"NumberOfFramesInPhase is {count:g}, got {len(pieces)} slices")
            before = piece - min(pieces) if number == phase else count or len(pieces)
            unknown = duration is None if before else number < phase
            if start is None or unknown:
                start = None
            else:
                start += (delay + before * pause) / 1000 + before * (duration or 0.0)
        return Frame(*moment, start, duration)  # pyrefly: ignore[unbound-name]
    gate = _item(dataset, "GatedInformationSequence", 1)
    step = _number("FrameTime", _item(gate, "DataInformationSequence", interval))
    if step is None:
        return Frame(*moment, None, None)
    back = gate.get("CardiacFramingType") == "BACK"  # slots end with the next R wave
    return Frame(*moment, None if back else (slot - 1) * step / 1000, step / 1000)


def _seconds(item: Any) -> float | None:
    """Duration of a frame in s; None if the item states none, or 0, as some programs write."""
    if (duration := _number(DURATION, item)) is not None and duration < 0:
        raise ValueError(f"ActualFrameDuration is not negative, got {duration:g} ms")
    return duration / 1000 if duration else None


def _item(dataset: Any, name: str, index: int) -> Any:
    """An item of a sequence, counted from 1; an empty one without a sequence."""
    items = dataset.get(name)
    if items and index > len(items):
        raise ValueError(f"{name} has {len(items)} items, got the number {index} in a vector")
    return items[index - 1] if items else {}


def _number(name: str, item: Any, index: int = 0, count: int = 1) -> float | None:
    """A finite number of an item, or that at an index of a list of `count`; None if it has none."""
    if (value := item.get(name)) is None or np.size(value) == 0 or value == "":
        return None
    values = np.atleast_1d(value).astype(float)
    if len(values) not in (1, count) or not np.isfinite(values).all():
        raise ValueError(f"{name} has one finite number or {count}, got {shown(value)}")
    return float(values[index if len(values) > 1 else 0])
