"""The attributes of DICOM NM's views that change counts or places. Requires pydicom."""

import warnings
from typing import Any

import numpy as np

from mvrecon.core.files.checks import Refused, file_errors, shown
from mvrecon.core.files.keys import Key, warn_of_unknown
from mvrecon.data.dicom_image import DERIVED, ONE_FILE, DicomImage, same

WINDOW = "EnergyWindowVector"
VIEW = ("DetectorVector", "RotationVector", "AngularViewVector")
#: Frame vectors of dynamic and gated studies.
TIME = ("PhaseVector", "TimeSliceVector", "RRIntervalVector", "TimeSlotVector")
#: Sequences whose items the vectors number.
DESCRIBED = {
    WINDOW: "EnergyWindowInformationSequence",
    "DetectorVector": "DetectorInformationSequence",
    "RotationVector": "RotationInformationSequence",
    "PhaseVector": "PhaseInformationSequence",
}
DURATION = "ActualFrameDuration"
COUNTS = ("{counts}", "{count}", "counts", "count", "cnts", "1")
#: Corrections after which views are no counts that a projector with attenuation, scatter, decay or
#: dead time makes, and types of images that are none of a camera at rest.
CORRECTED = {"ATTN", "SCAT", "DECY", "RAN", "DCAL", "DTIM", "CLN"}
OTHERWISE = {"TRANSMISSION", "RECON", "WHOLE"}
#: Attributes of which a study with several values is read with a warning.
DIFFER = ("TableTraverse", "TableHeight")
#: Difference of the times of slots in ms that is rounding, as of 857 ms in 4 slots.
ROUNDED_MS = 1.0
#: Attributes of measured views besides `mvrecon.data.dicom_image.KEYS`.
KEYS = (
    Key("Modality", "refused", "counts of a gamma camera", ("NM",)),
    Key(
        "MeasurementUnitsCodeSequence, Units",
        "compared",
        f"views are counts: refused unless {', '.join(COUNTS)}",
    ),
    Key("RescaleType", "refused", "counts", ("US", *COUNTS)),
    Key(
        "CorrectedImage, ImageType",
        "compared",
        f"counts as measured: refused with {', '.join(sorted({*CORRECTED, *OTHERWISE}))}",
    ),
    Key(
        "DecayCorrection, AttenuationCorrectionMethod, ScatterCorrectionMethod, "
        "RandomsCorrectionMethod, DetectorNormalizationCorrection",
        "refused",
        "counts as measured",
        ("NONE", "NO"),
    ),
    Key(
        "DecayCorrected, AttenuationCorrected, ScatterCorrected, RandomsCorrected, "
        "DeadTimeCorrected, DeadTimeCorrectionFlag, CountLossNormalizationCorrected, "
        "SensitivityCalibrated",
        "refused",
        "counts as measured",
        ("NO", "N"),
    ),
    Key(
        "DecayFactor, DeadTimeFactor, DoseCalibrationFactor, SliceSensitivityFactor",
        "refused",
        "counts as measured",
        (1,),
    ),
    Key("ScatterFractionFactor", "refused", "counts as measured", (0,)),
    Key("DecayCorrectionDateTime, SUVType, ReconstructionMethod", "refused", "counts as measured"),
    Key("WholeBodyTechnique, ScanVelocity", "refused", "a camera at rest"),
    Key("CountsSource", "refused", "of a transmission", ("EMISSION",)),
    Key(", ".join((WINDOW, *VIEW, *TIME)), "applied", "frame by frame"),
    Key(", ".join(DESCRIBED.values()), "applied", "numbered by its vector"),
    Key("SliceVector", "refused", "where slices differ: a volume"),
    *ONE_FILE,
    *DERIVED,
    Key(
        "StartAngle",
        "applied",
        "of the detector with one rotation, else of the rotation; both must have one in common",
    ),
    Key("AngularStep", "applied", "not negative"),
    Key("ScanArc, NumberOfFramesInRotation", "compared", "with AngularStep and AngularViewVector"),
    Key("RadialPosition", "applied", "as StartAngle; one value, or one of each view"),
    Key(
        DURATION,
        "applied",
        "of the phase, else of the rotation, else of the image; these must have one in common; "
        "unknown of gated frames; 0: not stated",
    ),
    Key("FrameTime", "applied", "of the one item of GatedInformationSequence"),
    Key(
        "CardiacFramingType", "applied", "of slots framed BACK from an R wave the start is unknown"
    ),
    Key("RotationDirection, PhaseDelay, PauseBetweenFrames, NumberOfFramesInPhase", "applied"),
    Key("PixelSpacing", "compared", "with the cameras' pixel size, by paired"),
    Key(
        "AcquisitionDateTime, AcquisitionDate, AcquisitionTime",
        "compared",
        "of the windows of a scatter estimate; warned of",
    ),
    Key(
        "EnergyWindowLowerLimit, EnergyWindowUpperLimit",
        "compared",
        "with the widths_kev of a scatter estimate",
    ),
    Key("ZoomFactor", "compared", "of the detectors, which have one PixelSpacing"),
    Key(", ".join(DIFFER), "compared", "of rotations; warned of"),
    Key("TimeSlotTime", "compared", "with each other and FrameTime; warned of"),
    Key("CountsAccumulated, FrameReferenceTime, HighRRValue, LowRRValue", "ignored", "statistics"),
    Key(
        "ZoomCenter, CenterOfRotationOffset, TypeOfDetectorMotion, FocalDistance, XFocusCenter, "
        "YFocusCenter, CollimatorType, CollimatorGridName, RotationOffset, GantryDetectorTilt, "
        "DistanceSourceToDetector, ViewCodeSequence, ImagePositionPatient, "
        "ImageOrientationPatient, PatientPosition, PatientOrientationCodeSequence",
        "ignored",
        "the cameras decide",
    ),
)


def check_counts(image: DicomImage) -> None:
    """Raise for another modality, another unit than counts, or views that are corrected, of a
    transmission or reconstructed.
    """
    if not image.stated("Modality"):
        raise Refused(f"{image.path}: expected Modality NM, got none")
    image.check([key for key in KEYS if key.name != "SliceVector"])
    if other := {unit for unit in image.units() if unit.lower() not in COUNTS}:
        raise Refused(
            f"{image.path}: expected MeasurementUnitsCodeSequence and Units of counts "
            f"({', '.join(COUNTS)}), got {', '.join(map(repr, sorted(other)))}"
        )
    words = {"CorrectedImage": CORRECTED, "ImageType": OTHERWISE}
    image.check_words(words, "emission counts as measured")


def check_alike(image: DicomImage) -> None:
    """Raise for detectors with several zooms; warn of what changes between rotations or time slots,
    and of texts and private attributes that may change the counts.
    """
    zooms = image.anywhere("ZoomFactor")
    if not all(same(zoom, zooms[0]) for zoom in zooms):
        raise Refused(
            f"{image.path}: expected one ZoomFactor of all detectors, which have one PixelSpacing, "
            f"got {shown(zooms)}; write a file for each"
        )
    for name in DIFFER:
        values = image.anywhere(name)
        if other := [value for value in values if not same(value, values[0])]:
            warnings.warn(
                f"{image.path}: has several values of {name}, {values[0]} and {other[0]}, which "
                f"the cameras must have",
                stacklevel=3,
            )
    with file_errors(image.path, "describes its time slots wrongly"):
        intervals = [one for items in image.anywhere("DataInformationSequence") for one in items]
        times = max(map(_slot_times, intervals), key=np.ptp, default=[0.0])
    if np.ptp(times) > ROUNDED_MS:
        warnings.warn(
            f"{image.path}: has several values of TimeSlotTime, or another FrameTime, in one R-R "
            f"interval, {min(times):g} to {max(times):g} ms, for which the counts of its frames "
            f"are not corrected",
            stacklevel=3,
        )
    warn_of_unknown(image.path, [*image.private(), *image.derived()])


def _slot_times(interval: Any) -> list[float]:
    """Durations in ms of an item of DataInformationSequence: of its slots, and their nominal one; 0
    of none.
    """
    slots = interval.get("TimeSlotInformationSequence") or []
    stated = [interval.get("FrameTime"), *(slot.get("TimeSlotTime") for slot in slots)]
    return [float(time) for time in stated if time not in (None, "")] or [0.0]
