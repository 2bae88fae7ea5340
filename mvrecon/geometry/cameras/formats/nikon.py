"""Nikon's (X-Tek's) geometry of a micro-CT scan, .xtekct."""

import re
import warnings
from pathlib import Path
from typing import NamedTuple

import torch

from mvrecon.core.files.checks import Refused, check_file, file_errors, text_of
from mvrecon.core.files.keys import (
    Key,
    check_keys,
    section_entries,
    unknown_entries,
    warn_of_unknown,
)
from mvrecon.geometry.cameras.camera import Cameras
from mvrecon.geometry.cameras.formats import common
from mvrecon.geometry.cameras.rigs import Detector
from mvrecon.geometry.rigid import euler_rotation

#: Entries of the section XTekCT; others are those of Nikon's own reconstruction.
NUMBERS = ("SrcToObject", "SrcToDetector", "DetectorPixelSizeX", "DetectorPixelSizeY")
ANGLES = ("InitialAngle", "AngularStep")
COUNTS = ("Projections", "DetectorPixelsX", "DetectorPixelsY")
#: Values of an entry that is switched off.
NO = ("false", "no", "none", "off", 0)
KEYS = (
    *(Key(name, "applied") for name in (*NUMBERS, *ANGLES, "ObjectTilt")),
    Key("ObjectOffsetX, ObjectRoll", "applied", "else by CentreOfRotationTop and Bottom"),
    Key(
        "CentreOfRotationTop, CentreOfRotationBottom, CentreOfRotation",
        "applied",
        "mm on the detector; warned of where ObjectOffsetX says otherwise",
    ),
    Key("Name, InputSeparator, InputFolderName", "applied", "of the images"),
    Key("WhiteLevel", "applied", "grey value of the flat field"),
    Key("Projections", "compared", "with the number of images"),
    Key("DetectorPixelsX, DetectorPixelsY", "compared", "with the images"),
    Key(".ang, _ctdata.txt", "compared", "files of measured angles, with AngularStep; warned of"),
    Key("Units", "refused", "lengths in mm", ("mm",)),
    Key("DetectorOffsetX, DetectorOffsetY", "refused", "give camera=circular an offset_mm", (0,)),
    Key("Shuttling", "refused", "images in the order of their angles", NO),
    Key("InvertedImages", "refused", "grey values that rise with intensity", NO),
    Key("AngleFile", "refused", "AngularStep alone; give camera=circular with camera.angles", NO),
    Key(
        "Angles",
        "refused",
        "AngularStep alone; give camera=circular with camera.angles",
        ("equal", "equidistant", "even", "linear", "regular", "uniform"),
    ),
    Key(
        "FluxNormalisation",
        "refused",
        "WhiteLevel alone; remove it, and say calibrate=[gains], or give views.exposure",
        NO,
    ),
    Key("FramesPerProjection", "ignored", "WhiteLevel is that of the averaged images"),
    Key("Scattering", "refused", "of Nikon's own reconstruction", (0,)),
    Key(
        "Voxels*, VoxelSize*, OffsetX, OffsetY, OffsetZ, MaskRadius, Region*",
        "ignored",
        "grid has the voxels",
    ),
    Key("CoefX*, Scale, BeamHardening*", "ignored", "its beam hardening presets"),
    Key(
        "FilterType, CutOffFrequency, Exponent, Normalisation, InterpolationType, *KernelSize, "
        "OrderFFT, DerivativeType, Blanking, Increment",
        "ignored",
        "of its own reconstruction",
    ),
    Key(
        "Output*, Scaling*, AutoScalingType, TIFFScaling, ImportConversion, *Percentile, "
        "TimeStampFolder, AutomaticCentreOfRotation*, VirtualDetector*, SrcToVirtualDetector",
        "ignored",
        "of its volume",
    ),
    Key("OperatorID, ModifierID, InputName, InputDigits, Version, Product", "ignored", "texts"),
    Key("XraykV, XrayuA, Filter_*", "ignored", "the tube and its filter"),
)
#: A line of measured angles: number of the projection and degrees; share by which steps may differ.
LISTED, MAX_STEP_DIFFERENCE = re.compile(r"\s*(\d+)[\s:]+([-+]?\d*\.?\d+(?:[eE][-+]?\d+)?)\b"), 0.1
#: Entries of the section CTPro that count as those of XTekCT.
CTPRO = ("shuttling", "anglefile_use")
#: Sections of the tube, of Nikon's own reconstruction and of texts; entries in these that would
#: count in XTekCT are named, unless they repeat it.
OTHER_SECTIONS = ("[ctpro]", "[xrays]", "[dicom]")


USED = {n.lower() for key in KEYS if key.use in ("applied", "refused") for n in key.names}


class Header(NamedTuple):
    """Entries of the section XTekCT."""

    path: Path
    texts: dict[str, str]

    def number(self, name: str, absent: float | None = None) -> float:
        """A number.

        Raises:
            Refused: it is missing without a default, or not a finite number.
        """
        text = self.texts.get(name.lower(), "")
        if not text:
            if absent is None:
                raise Refused(f"{self.path}: expected the entry {name}, got none")
            return absent
        with file_errors(self.path, f"has no {name}", "expected a number"):
            return common.number(text, name)


def header(path: str | Path) -> Header:
    """Read the file's entries.

    Warns:
        UserWarning: entries that mvrecon does not know.

    Raises:
        FileNotFoundError: nothing is there.
        Refused: no section XTekCT, or an entry to refuse (`KEYS`).
    """
    path = Path(path)
    check_file(path, "Nikon's .xtekct")
    texts: dict[str, str] = {}
    others: dict[str, str] = {}
    for section, name, value in section_entries(path):
        own = section == "[xtekct]" or (section == "[ctpro]" and name in CTPRO)
        if own and texts.setdefault(name, value) != value:
            raise Refused(f"{path}: expected one {name}, got {texts[name]} and {value}")
        if not own and (section not in OTHER_SECTIONS or name in USED):
            others[f"{section} {name}"] = value
    if not texts:
        raise Refused(f"{path}: expected a section [XTekCT] of Nikon's, got none")
    check_keys(path, KEYS, lambda key: _either(texts, key))
    if _angle_files(path):
        texts.pop("anglefile_use", None)  # they are compared
    repeated = {name for name, value in others.items() if texts.get(name.split()[-1]) == value}
    others = {name: value for name, value in others.items() if name not in repeated}
    warn_of_unknown(path, [*unknown_entries(texts, KEYS), *unknown_entries(others, ())])
    return Header(path, texts)


def _either(texts: dict[str, str], key: str) -> str | None:
    """The value of the first of several entries that is not neutral, else of any."""
    values = [texts[name.lower()] for name in key.split(", ") if texts.get(name.lower())]
    return next((value for value in values if value.strip("0.") != ""), None)


def read(path: str | Path) -> Cameras:
    """Rig in mm from Nikon's .xtekct.

    Args:
        path: path of the file.

    Convention: as the Core Imaging Library reads it (Jørgensen and others, Phil. Trans. R. Soc. A
    379, 2021): the object turns clockwise by AngularStep seen from above, from InitialAngle; the
    images are stored as seen from the detector's back, so that their columns are to be reversed
    (`views.flip_columns`; the views of an .xtekct are); the axis is ObjectOffsetX to the left of
    the beam's axis, leant by ObjectTilt and ObjectRoll. World z is the axis, upwards.

    Warns:
        UserWarning: a file .ang or _ctdata.txt beside it with other steps than AngularStep.

    Raises:
        FileNotFoundError: nothing is there.
        ValueError: a missing or invalid entry, or distances that are not 0 < SrcToObject <
            SrcToDetector.
    """
    entries = header(path)
    sid, sdd, right, down = (entries.number(name) for name in NUMBERS)
    start, step = (entries.number(name) for name in ANGLES)
    count, columns, rows = (entries.number(name) for name in COUNTS)
    with file_errors(path, "is no rig", "expected Nikon's .xtekct"):
        common.check_distances(sid, sdd)
        if not (count == int(count) and 1 <= count <= common.VIEWS):
            raise Refused(f"{path}: expected 1 to {common.VIEWS} Projections, got {count:g}")
        if count > 1 and step == 0:
            raise Refused(f"{path}: expected an AngularStep between {count:g} Projections, got 0")
        plate = Detector((int(rows), int(columns)), (down, right))
        middle = entries.number("CentreOfRotation", 0.0)
        bottom = entries.number("CentreOfRotationBottom", middle)
        top = entries.number("CentreOfRotationTop", bottom)
        bottom = entries.number("CentreOfRotationBottom", top)
        centre = (top + bottom) / 2 * sid / sdd
        aside = entries.number("ObjectOffsetX", centre)
        if centre and abs(aside - centre) * sdd / sid > right / 2:
            warnings.warn(
                f"{path}: ObjectOffsetX {aside:g} is taken for the axis of rotation, which is at "
                f"{centre:g} mm by CentreOfRotation; calibrate=[offset_u] finds it",
                stacklevel=2,
            )
        lean = torch.rad2deg(torch.atan2(torch.tensor(bottom - top), torch.tensor(rows * down)))
        roll = entries.number("ObjectRoll", lean.item())
        tilt = -entries.number("ObjectTilt", 0.0)
        # the axis in the scanner's frame: x to the right and y ahead as seen from the source
        leant = torch.tensor([tilt, roll, 0.0], dtype=torch.float64)
        upright = euler_rotation(leant, "xyz").mT
        place = torch.tensor([-aside, sid, 0.0], dtype=torch.float64)
        source, centre = (
            upright @ (torch.tensor([0.0, ahead, 0.0], dtype=torch.float64) - place)
            for ahead in (0.0, sdd)
        )
        u, v = (
            upright @ torch.tensor(axis, dtype=torch.float64)
            for axis in ([1.0, 0.0, 0.0], [0.0, 0.0, -1.0])
        )
        _warn_of_steps(path, step)
        turns = torch.zeros(int(count), 3, dtype=torch.float64)
        turns[:, 2] = start - 180 + step * torch.arange(int(count), dtype=torch.float64)
        R = euler_rotation(turns, "xyz")
        looking = torch.stack([R @ u, R @ v, R @ torch.linalg.cross(u, v)], dim=1)
        return plate.carried(R @ source, R @ centre, looking)


def _angle_files(path: str | Path) -> list[Path]:
    """The lists of measured angles beside a header, .ang or _ctdata.txt."""
    return sorted([*Path(path).parent.glob("*.ang"), *Path(path).parent.glob("*_ctdata.txt")])


def _warn_of_steps(path: str | Path, step: float) -> None:
    """Warn of a list of measured angles in other steps."""
    for file in _angle_files(path):
        lines = map(LISTED.match, text_of(file, strict=False).splitlines())
        listed = [[float(line[1]), float(line[2])] for line in lines if line]
        numbers, angles = torch.tensor(listed, dtype=torch.float64).reshape(-1, 2).T
        steps = (angles.diff().abs() + 180) % 360 - 180  # of either sense
        steps = steps[numbers.diff().abs() == 1]  # headings may be numbers as well
        off = (steps.abs() - abs(step)).abs()
        if len(off) and off.max() > MAX_STEP_DIFFERENCE * abs(step):
            warnings.warn(
                f"{file}: states steps of {steps.abs().min():g} to {steps.abs().max():g} degrees, "
                f"which are not read; AngularStep {step:g} of {path} counts",
                stacklevel=3,
            )
