"""Projections in DICOM: X-ray images of one view or of several frames, and DICOM-CT-PD. Needs
pydicom: the extra `io`.
"""

from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path

import numpy as np

from mvrecon.core.files.checks import Refused, shown
from mvrecon.core.files.keys import Key
from mvrecon.data.dicom_image import DERIVED, ONE_FILE, DicomImage
from mvrecon.data.dicom_pixels import pixels_of, scales_of, stored_type
from mvrecon.data.projections import exposures
from mvrecon.data.projections.stack import Header

#: Attributes of DICOM projections that all views have in common.
ALIKE = (
    "FieldOfViewShape FieldOfViewOrigin FieldOfViewDimensions FieldOfViewDimensionsInFloat "
    "PixelDataAreaOriginRelativeToFOV DetectorBinning DetectorActiveOrigin "
    "DetectorActiveDimensions PhysicalDetectorSize IntensifierSize "
    "IntensifierActiveDimensions CassetteOrientation XRayImageReceptorTranslation "
    "XRayImageReceptorAngle RTImagePlane RTImageOrientation RTImagePosition"
).split()
#: Attributes of DICOM projections that change grey values, but not in proportion, or may have been
#: stored in another way; those from SourceIndex on are of DICOM-CT-PD.
BEAM = (
    "KVP AnodeTargetMaterial FocalSpots RectificationType HalfValueLayer XRayOutput RadiationMode "
    "RadiationSetting ExposureStatus Sensitivity DetectorMode DetectorType DetectorID "
    "DetectorConditionsNominalFlag XRayReceptorType PlateType PhosphorType LINACEnergy LINACOutput "
    "AcquisitionDeviceProcessingDescription AcquisitionDeviceProcessingCode "
    "LinearityCorrectionTechnique BeamHardeningCorrectionTechnique FilterMaterial FilterType "
    "TypeOfFilters FilterThicknessMinimum FilterThicknessMaximum FilterBeamPathLengthMinimum "
    "FilterBeamPathLengthMaximum Grid GridID GridAbsorbingMaterial GridSpacingMaterial "
    "GridThickness GridPitch GridPeriod GridAspectRatio GridFocalDistance "
    "PhotometricInterpretation SourceIndex SpectrumIndex BeamHardeningCorrectionFlag "
    "GainCorrectionFlag DarkFieldCorrectionFlag FlatFieldCorrectionFlag BadPixelCorrectionFlag "
    "ScatterCorrectionFlag"
).split()
#: Changes of the table's place from the first frame on, a number for each frame.
STEPS = ["TableVerticalIncrement", "TableLateralIncrement", "TableLongitudinalIncrement"]
#: Attributes of DICOM projections that say where a camera is; those from DetectorCentralElement on
#: are of DICOM-CT-PD.
CAMERA_PLACES = (
    "DistanceSourceToDetector DistanceSourceToIsocenter "
    "DistanceReceptorPlaneToDetectorHousing RTImageSID RadiationMachineSAD "
    "PositionOfIsocenterProjection PlaneIdentification DetectorPrimaryAngle "
    "DetectorSecondaryAngle PositionerIsocenterDetectorRotationAngle DetectorCentralElement "
    "ConstantRadialDistance DetectorFocalCenterAxialPosition "
    "DetectorFocalCenterRadialDistance SourceAngularPositionShift SourceAxialPositionShift "
    "SourceRadialDistanceShift"
).split()
#: Angles by which the camera is turned about the patient, and those by which it is tilted, which
#: must be within so many degrees from zero.
PRIMARY = {
    "PositionerPrimaryAngle": "PositionerSecondaryAngle",
    "PositionerIsocenterPrimaryAngle": "PositionerIsocenterSecondaryAngle",
    "GantryAngle": "GantryPitchAngle",
}
MAX_TILT = 5.0
#: Ratio of the greatest to the least of increments from frame to frame; those from the first frame
#: on differ more.
MAX_UNEVEN = 1.5
#: Attributes that say where the object is, or move it; a flat field has none.
OBJECT_PLACES = [
    *(
        "DistanceSourceToPatient DistanceSourceToEntrance DistanceSourceToSupport "
        "DistanceObjectToTableTop IsocenterPosition PatientPosition PatientSupportAngle "
        "TableHeight "
        "TableTraverse TableAngle TablePosition TableXPositionToIsocenter "
        "TableYPositionToIsocenter TableZPositionToIsocenter TableHorizontalRotationAngle "
        "TableHeadTiltAngle TableCradleTiltAngle TableTopVerticalPosition "
        "TableTopLongitudinalPosition TableTopLateralPosition TableTopEccentricAngle "
        "TableTopPitchAngle TableTopRollAngle BreastSupportXPositionToIsocenter "
        "BreastSupportYPositionToIsocenter BreastSupportZPositionToIsocenter "
        "BreastSupportIsocenterPrimaryAngle BreastSupportIsocenterSecondaryAngle"
    ).split(),
    *STEPS,
]
#: Attributes by which frames of a file are in order.
ORDER = [
    *("FrameAcquisitionNumber", "FrameAcquisitionDateTime", "FrameReferenceDateTime"),
    *("TemporalPositionIndex", "DimensionIndexValues"),
]
#: Attributes by which views in files of their own were acquired: a number, and times.
ACQUIRED = ("AcquisitionNumber", "AcquisitionDateTime", "AcquisitionDate", "AcquisitionTime")
#: Rows and columns of the detector in DICOM-CT-PD, and the sizes of a pixel along these.
PIXELS = ("NumberofDetectorRows", "NumberofDetectorColumns")
PITCHES = ("DetectorElementAxialSpacing", "DetectorElementTransverseSpacing")
#: Other objects than projections, by their modality, the words of their type, and the end of their
#: SOP class: volumes of CT, PET, MR, X-ray 3D, doses, labels and maps.
NO_PROJECTIONS = {
    "Modality": {"PT", "MR", "US", "SEG", "RTDOSE"},
    "ImageType": {"LOCALIZER", "MPR", "RECON", "SUBTRACTION"},
    "SOPClassUID": {
        f"1.2.840.10008.5.1.4.1.1.{end}"
        for end in (
            "2.1 2.2 4 4.1 4.4 13.1.1 13.1.2 13.1.3 30 66.4 66.5 128 128.1 130 481.2"
        ).split()
    },
}
#: All that are compared between views with a warning.
COMPARED = (*exposures.DICOM, *BEAM, *CAMERA_PLACES, *OBJECT_PLACES)
#: Attributes of DICOM projections besides `dicom_image.KEYS`.
DICOM_KEYS = (
    *DERIVED,
    Key("MeasurementUnitsCodeSequence, Units", "compared", "with the kind of the views"),
    Key(
        "PixelIntensityRelationship",
        "refused",
        "grey values in proportion to intensity; convert the images, and say kind=integrals "
        "(views.kind)",
        ("LIN",),
    ),
    Key(
        "PixelIntensityRelationshipSign",
        "refused",
        "grey values that rise with intensity; invert those that fall",
        (1,),
    ),
    Key("LUTFunction", "refused", "grey values in proportion to intensity", ("TO_LOG",)),
    Key("PresentationIntentType", "refused", "not processed for display", ("FOR PROCESSING",)),
    Key(
        "LogFlag",
        "refused",
        "DICOM-CT-PD's: convert its logarithms, and say kind=integrals (views.kind)",
        ("NO",),
    ),
    Key(
        "ImageProcessingApplied",
        "refused",
        "grey values in proportion to intensity",
        ("NONE", "FRAME_AVERAGING"),
    ),
    Key(
        "FluoroscopyPersistenceFlag, FluoroscopyLastImageHoldPersistenceFlag",
        "refused",
        "a view of its own in each image",
        ("NO",),
    ),
    Key("RescaleType", "refused", "grey values; convert those of another unit", ("US",)),
    Key(
        "FieldOfViewRotation, PixelDataAreaRotationAngleRelativeToFOV, RotationOfScannedFilm",
        "refused",
        "pixels in the detector's order",
        (0,),
    ),
    Key("FieldOfViewHorizontalFlip", "refused", "pixels in the detector's order", ("NO",)),
    Key("GeometricalProperties", "refused", "pixels of one size; rectify the images", ("UNIFORM",)),
    Key(
        "TableMotion",
        "refused",
        "an object at rest; where the cameras move in its place, state STATIC",
        ("STATIC",),
    ),
    Key(
        "DetectorShape",
        "refused",
        "DICOM-CT-PD's: cameras are flat; convert the views to those of a flat detector",
        ("FLAT",),
    ),
    Key("FlyingFocalSpotMode", "refused", "DICOM-CT-PD's: one focal spot", ("FFSNONE",)),
    Key(", ".join(PIXELS), "compared", "DICOM-CT-PD's, with Rows and Columns"),
    Key(", ".join(PITCHES), "compared", "DICOM-CT-PD's, as ImagerPixelSpacing"),
    Key(
        ", ".join(NO_PROJECTIONS),
        "compared",
        "volumes, localizers, differences, doses and labels are refused",
    ),
    *ONE_FILE,
    Key("AppliedMaskSubtractionFlag", "refused", "grey values, not differences", ("NO",)),
    Key("ImagerPixelSpacing", "compared", "with the cameras' pixel size"),
    Key("NominalScannedPixelSpacing", "compared", "as ImagerPixelSpacing, and with it"),
    Key(", ".join(ALIKE), "compared", "one of all views"),
    Key(
        ", ".join(exposures.DICOM),
        "compared",
        "of views and flat fields; warned of, applied by views.exposure, where others must agree",
    ),
    Key(", ".join(BEAM), "compared", "of views and flat fields; warned of"),
    Key("ExposureIndex, DeviationIndex", "ignored", "of the grey values, also of the object"),
    Key("ImageAndFluoroscopyAreaDoseProduct", "ignored", "may be a sum over images"),
    Key("PhotonStatistics", "ignored", "noise of the beam, which exposures state"),
    Key("WaterAttenuationCoefficient", "ignored", "of the Hounsfield units of a reconstruction"),
    Key("InstanceNumber", "applied", "order of the views in files of their own"),
    Key(", ".join(ORDER), "compared", "with the order of the frames"),
    Key(", ".join(ACQUIRED), "compared", "with the order by InstanceNumber; warned of"),
    Key(
        "PixelSpacing, ImagePlanePixelSpacing, ObjectPixelSpacingInCenterOfBeam",
        "ignored",
        "may be that of the object",
    ),
    Key("DetectorActiveTime, ExposureDoseSequence", "ignored", "views state their own exposures"),
    Key("DetectorElementSpacing", "ignored", "ImagerPixelSpacing is that of binned pixels"),
    Key("DarkCurrentSequence, GainCorrectionReferenceSequence", "ignored", "views.dark and flat"),
    Key("BadPixelImage", "ignored", "views.bad_pixels"),
    Key("CollimatorShape, CollimatorShapeSequence", "ignored", "pixels behind it are measured"),
    Key(
        ", ".join(CAMERA_PLACES),
        "compared",
        "of views and flat fields; warned of, as the camera decides",
    ),
    Key(", ".join(OBJECT_PLACES), "compared", "of all views; warned of, as the camera decides"),
    Key(
        ", ".join((*PRIMARY, "PositionerPrimaryAngleIncrement")),
        "compared",
        "with the turn of the cameras, where they are hardly tilted; warned of",
    ),
    Key(
        "PositionerSecondaryAngle, PositionerSecondaryAngleIncrement, "
        "PositionerIsocenterSecondaryAngle, BeamAngle, ColumnAngulation, "
        "GantryPitchAngle, TubeAngle, FramePrimaryAngleVector, FrameSecondaryAngleVector, "
        "XRaySourceIsocenterPrimaryAngle, DetectorIsocenterPrimaryAngle, "
        "DetectorXPositionToIsocenter, DetectorYPositionToIsocenter, DetectorZPositionToIsocenter, "
        "RTImageFrameImagingDevicePositionSequence, SpiralPitchFactor, TableFeedPerRotation, "
        "EstimatedRadiographicMagnificationFactor, ImagePositionPatient, ImageOrientationPatient, "
        "PatientOrientation, ViewPosition, DetectorActiveAreaTLHCPosition, "
        "DetectorActiveAreaOrientation, DetectorFocalCenterAngularPosition, "
        "NumberofSourceAngularSteps, TypeofProjectionData, TypeofProjectionGeometry",
        "ignored",
        "the camera decides",
    ),
)


def dicom_header(file: Path) -> Header:
    """Integers if values are stored numbers; else floats, whose largest value is that of the
    stored bits, scaled.
    """
    image = DicomImage(file)
    if image.value("Modality") == "NM" and image.frames > 1:
        raise Refused(
            f"{file}: expected projections in the order of the file, got frames of NM, which is to "
            f"be sorted by its vectors; the plugin mvrecon-spect reads such a file (views.path)"
        )
    image.check(DICOM_KEYS)
    image.check_words(NO_PROJECTIONS, "projections")
    for name in ORDER:
        numbers = [n for n in image.values(name) if n is not None]
        if any(later < earlier for earlier, later in pairwise(numbers)):
            raise Refused(
                f"{file}: expected frames in the order of their {name}, got {shown(numbers)}; sort "
                f"the frames"
            )
    for name, size in zip(PIXELS, image.shape, strict=True):
        if (stated := image.value(name)) is not None and int(stated) != size:
            raise Refused(
                f"{file}: expected images with as many rows and columns, {image.shape}, as the "
                f"detector of DICOM-CT-PD, got {name} {stated}; transpose the images"
            )
    (kind, ends), scales = stored_type(image), {scale[:2] for scale in scales_of(image)}
    tops = {max(slope * end + d for end in ends) if ends else None for slope, d in scales}
    return Header(
        image.shape,
        kind if scales == {(1.0, 0.0)} else np.dtype("f4"),
        image.frames,
        frozenset(tops),
        image.pixel_mm("ImagerPixelSpacing", "NominalScannedPixelSpacing", ", ".join(PITCHES)),
        tuple(map(image.value, ALIKE)),
        {name: _texts(image, name) for name in COMPARED},
        image.value("PixelIntensityRelationship") == "LIN",
        unknown=[*image.private(), *image.derived()],
        units=", ".join(sorted(unit.strip("{}") for unit in image.units())),
        angles=_angles(image),
    )


def _angles(image: DicomImage) -> list[float]:
    """The angles in degrees by which the camera is turned, a number for each frame; none unless
    they are stated, and it is hardly tilted.
    """
    steps, aside = (
        np.atleast_1d(np.asarray(image.value(f"Positioner{axis}AngleIncrement") or 0, float))
        for axis in ("Primary", "Secondary")
    )
    for name, tilt in PRIMARY.items():
        angles, tilts = image.values(name), [float(t or 0) for t in image.values(tilt)]
        if None in angles or max(map(abs, tilts)) + abs(aside).max() > MAX_TILT:
            continue
        turn = np.array(angles, float)
        if len(steps) == image.frames > 1:
            wide = abs(steps[1:])
            each = wide.max() < MAX_UNEVEN * wide.min()
            turn += steps.cumsum() if each else steps
        return turn.tolist()
    return []


def _texts(image: DicomImage, name: str) -> list[str]:
    """An attribute of each frame of an image as text; "" where it is not stated."""
    if name in STEPS and len(steps := np.atleast_1d(image.value(name) or 0)) == image.frames:
        return [str(step) for step in steps]
    single = image.groups and image.stated(name)
    found = (
        {str(value) for _, value in image.stated(name, k)}
        for k in range(image.frames if single else 1)
    )
    texts = [" or ".join(sorted(values)) for values in found]
    return texts if single else texts * image.frames


def dicom_pages(file: Path, first: int, last: int) -> Iterator[np.ndarray]:
    values = pixels_of(file)
    yield from values.reshape(-1, *values.shape[-2:])[first:last]
