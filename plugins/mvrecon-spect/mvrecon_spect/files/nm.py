"""DICOM NM: frames sorted by their vectors, with energy windows, angles and radii; gated and
dynamic studies frame by frame. Requires pydicom.

PS3.3, C.8.4: a frame's entries in the vectors EnergyWindowVector, DetectorVector, RotationVector
and AngularViewVector identify it; frames may be in any order. Angles are zero at the patient's back
and increase towards the patient's left (counter-clockwise, viewed from the feet).
"""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from mvrecon.core.files.checks import Refused, file_errors
from mvrecon.core.files.keys import Key, check_keys
from mvrecon.data.dicom import frames_of, header_of, pixels_of, value_of
from mvrecon.geometry.cameras.camera import Cameras

WINDOW = "EnergyWindowVector"
VIEW = ("DetectorVector", "RotationVector", "AngularViewVector")
#: Frame vectors of dynamic and gated studies.
TIME = ("PhaseVector", "TimeSliceVector", "RRIntervalVector", "TimeSlotVector")
Moment = tuple[int, int, int, int]
COUNTS = ("{counts}", "{count}", "counts", "count", "cnts", "1", "")
#: Attributes of measured views besides `mvrecon.data.dicom.KEYS`.
KEYS = (
    Key("Modality", "refused", "counts of a gamma camera", ("NM",)),
    Key("Units", "refused", "counts", COUNTS),
    Key(
        "MeasurementUnitsCodeSequence",
        "refused",
        "of the real world value mapping: views are counts",
        COUNTS,
    ),
    Key("CorrectedImage", "refused", "with ATTN, SCAT or DECY; views are counts as measured"),
    *(Key(name, "applied") for name in (WINDOW, *VIEW, *TIME)),
    Key("SliceVector", "refused", "where slices differ: a volume"),
    *(Key(name, "applied") for name in ("StartAngle", "AngularStep", "RotationDirection")),
    Key("RadialPosition", "applied", "of the rotation, else of the detector"),
    *(Key(name, "applied") for name in ("ActualFrameDuration", "FrameTime", "PhaseDelay")),
    Key("PauseBetweenFrames", "applied"),
    Key("PixelSpacing", "compared", "with the cameras' pixel size, by paired"),
    Key("ZoomFactor, ZoomCenter", "ignored", "PixelSpacing includes them"),
    Key("CountsAccumulated, ScanArc", "ignored", "statistics, and repeated by the views"),
)
#: Corrections after which views are no counts that a projector with attenuation or scatter makes.
CORRECTED = {"ATTN", "SCAT", "DECY"}


class View(NamedTuple):
    """Identity of a view: detector, rotation and number in the rotation, from 1; angle in degrees,
    distance of the detector from the axis in mm and duration in s, each None if the file
    does not contain it.
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
    None if the file does not contain them.
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
    views and the pixel size (v, u) in mm.
    """

    windows: tuple[EnergyWindow, ...]
    counts: tuple[Float[Tensor, "1 1 m v u"], ...]
    views: tuple[View, ...]
    pixel_mm: tuple[float, float]


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
    dataset = header_of(path)
    count = frames_of(dataset)
    if len(set(frame_numbers(path, dataset, "SliceVector", count))) > 1:
        raise Refused(f"{path}: expected measured views, got the slices of a volume")
    _check_counts(path, dataset, count)
    phase, piece, interval, slot, window, *place = (
        frame_numbers(path, dataset, name, count) for name in (*TIME, WINDOW, *VIEW)
    )
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
    pixels = torch.from_numpy(pixels_of(path)).reshape(count, dataset.Rows, dataset.Columns)
    if not (pixels >= 0).all():
        raise Refused(f"{path}: expected counts, not negative, got {pixels.min().item():g}")
    with file_errors(path, "has no PixelSpacing in mm"):
        down, along = (float(step) for step in dataset.PixelSpacing)
    with file_errors(path, "describes its windows, detectors, rotations or phases wrongly"):
        _check_starts(path, dataset, known)
        views = tuple(_view(dataset, key) for key in known)
        energies = tuple(_window(dataset, index) for index in windows)
        frames = [_frame(dataset, moment, moments) for moment in moments]

    def study(moment: Moment) -> NmStudy:
        chosen = ([order[moment, index, key] for key in known] for index in windows)
        counts = tuple(pixels[images][None, None] for images in chosen)
        return NmStudy(energies, counts, views, (down, along))

    return ((frame, study(moment)) for frame, moment in zip(frames, moments, strict=True))


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


def _check_counts(path: Path, dataset: Any, frames: int) -> None:
    """Raise for another modality, another unit than counts, or corrected views."""
    units = [
        str(code.get("CodeValue") or "")
        for frame in range(frames)
        for item in value_of(dataset, "RealWorldValueMappingSequence", frame) or []
        for code in item.get("MeasurementUnitsCodeSequence") or []
    ]
    other = next((unit for unit in units if unit.lower() not in COUNTS), None)
    stated = {"Modality": str(dataset.get("Modality")), "Units": dataset.get("Units")}
    check_keys(path, KEYS, {**stated, "MeasurementUnitsCodeSequence": other}.get)
    corrected = dataset.get("CorrectedImage") or []
    corrected = {corrected} if isinstance(corrected, str) else set(corrected)
    if corrected & CORRECTED:
        raise Refused(
            f"{path}: expected counts as measured, got CorrectedImage with "
            f"{', '.join(sorted(corrected & CORRECTED))}"
        )


def frame_numbers(path: Path, dataset: Any, name: str, frames: int) -> list[int]:
    """The number of each frame in a vector of a file, from 1; ones if it has none."""
    if (value := dataset.get(name)) is None:
        return [1] * frames
    values = [int(v) for v in (value if isinstance(value, Sequence) else [value])]
    if len(values) != frames or min(values) < 1:
        raise Refused(
            f"{path}: expected {name} of {frames} numbers from 1 on, one a frame, got {len(values)}"
        )
    return values


def _window(dataset: Any, index: int) -> EnergyWindow:
    item = _item(dataset, "EnergyWindowInformationSequence", index)
    ranges = item.get("EnergyWindowRangeSequence") or []
    limits = [(float(r.EnergyWindowLowerLimit), float(r.EnergyWindowUpperLimit)) for r in ranges]
    if not all(0 <= low < high for low, high in limits):
        raise ValueError(f"energy windows need lower < upper keV, got {limits}")
    return EnergyWindow(str(item.get("EnergyWindowName") or ""), tuple(limits))


def _check_starts(path: Path, dataset: Any, views: Sequence[tuple[int, int, int]]) -> None:
    """Raise if several detectors would get the same angles because only their rotation states a
    start angle, or each of several rotations.
    """
    detectors, turns = sorted({view[0] for view in views}), sorted({view[1] for view in views})
    own = [_start(dataset, "DetectorInformationSequence", number) for number in detectors]
    of_turns = [_start(dataset, "RotationInformationSequence", number) for number in turns]
    if len(detectors) < 2 or of_turns.count(None) == len(turns):
        return
    if None in own:
        without = [n for n, start in zip(detectors, own, strict=True) if start is None]
        raise Refused(
            f"{path}: expected a StartAngle of each of the {len(detectors)} detectors, got none of "
            f"detector {', '.join(map(str, without))}: by that of the rotation alone, "
            f"{of_turns[0]}, the heads would all have the same angles; set it in "
            f"DetectorInformationSequence"
        )
    if len(turns) > 1 and len(set(own)) > 1:
        raise Refused(
            f"{path}: expected one rotation of detectors with different StartAngle, got "
            f"{len(turns)} with a StartAngle each, which does not say where each detector starts; "
            f"write a file for each rotation"
        )


def _start(dataset: Any, name: str, index: int) -> float | None:
    """The start angle in an item of a sequence in degrees; None if there is none."""
    return _number(_item(dataset, name, index).get("StartAngle"), 0)


def _view(dataset: Any, key: tuple[int, int, int]) -> View:
    """Identity of a view. With one rotation, each detector has its own start angle; with several,
    each rotation has one.
    """
    detector, rotation, number = key
    own = _item(dataset, "DetectorInformationSequence", detector)
    turns = dataset.get("RotationInformationSequence") or []
    turn = _item(dataset, "RotationInformationSequence", rotation)
    first, second = (own, turn) if len(turns) < 2 else (turn, own)
    angle = _number(first.get("StartAngle"), 0)
    angle = _number(second.get("StartAngle"), 0) if angle is None else angle
    if angle is not None and (step := _number(turn.get("AngularStep"), 0)) is not None:
        sense = {"CW": -1, "CC": 1}[turn.RotationDirection]
        angle = (angle + sense * step * (number - 1)) % 360
    radius = _number(turn.get("RadialPosition"), number - 1)
    if radius is None:
        radius = _number(own.get("RadialPosition"), number - 1)
    duration = _number(turn.get("ActualFrameDuration") or dataset.get("ActualFrameDuration"), 0)
    return View(*key, angle, radius, None if duration is None else duration / 1000)


def _frame(dataset: Any, moment: Moment, moments: Sequence[Moment]) -> Frame:
    """Start and duration of a frame, from the preceding phases of dynamic studies or the nominal
    slot time of gated ones; PS3.3, C.8.4.11 and C.8.4.14.
    """
    phase, piece, interval, slot = moment
    if dataset.get("PhaseInformationSequence"):
        start = 0.0
        for number in range(1, phase + 1):
            item = _item(dataset, "PhaseInformationSequence", number)
            duration, pause = float(item.ActualFrameDuration), float(item.PauseBetweenFrames or 0)
            first = min(p for n, p, *_ in moments if n == number)
            before = piece - first if number == phase else int(item.NumberOfFramesInPhase)
            start += float(item.PhaseDelay or 0) + before * (duration + pause)
        return Frame(*moment, start / 1000, duration / 1000)  # pyrefly: ignore[unbound-name]
    gate = _item(dataset, "GatedInformationSequence", 1)
    step = _number(_item(gate, "DataInformationSequence", interval).get("FrameTime"), 0)
    if step is None:
        return Frame(*moment, None, None)
    return Frame(*moment, (slot - 1) * step / 1000, step / 1000)


def _item(dataset: Any, name: str, index: int) -> Any:
    """An item of a sequence, counted from 1; an empty one without a sequence."""
    items = dataset.get(name)
    return items[index - 1] if items else {}


def _number(value: Any, index: int) -> float | None:
    """A number, or the number of a list at an index; None if there is none."""
    if value is None or value == "":
        return None
    if isinstance(value, Sequence) and not isinstance(value, str):
        return float(value[index]) if len(value) > 1 else float(value[0]) if value else None
    return float(value)
