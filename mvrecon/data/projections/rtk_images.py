"""Projections of linacs and of the ESRF through RTK's own readers (Rit and others, J. Phys. Conf.
Ser. 489, 2014), the extra `rtk`: Varian's .hnc, .hnd and .xim, Elekta's .his, and .edf.

Values are RTK's before its logarithm: grey values that rise with intensity. RTK reverses those of
.his, 65536 - v, and leaves out its four outer rows and columns.
"""

import os
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from mvrecon.core.files.checks import EDGE, Refused, check_declared, io_library
from mvrecon.core.files.keys import (
    FREE_TEXT,
    IMAGE_EFFECTS,
    Key,
    check_keys,
    has_effect,
    unknown_entries,
    unknown_names,
)
from mvrecon.core.files.prose import stated_effects
from mvrecon.data.projections.exposures import number_of
from mvrecon.data.projections.stack import Header

#: Formats by their ending.
ENDINGS = {".hnc": "HNC", ".hnd": "HND", ".xim": "XIM", ".his": "HIS", ".edf": "EDF"}
#: Pixels of a format: stored type, and whether its header states their size.
PIXELS = {
    "HNC": ("u2", True),
    "HND": ("i4", True),
    "XIM": ("i4", True),
    "HIS": ("u2", False),
    "EDF": ("", False),
}
#: Types of the pixels of EDF, in lower case.
EDF_TYPES = {
    **{"unsignedbyte": "u1", "unsignedshort": "u2", "unsignedinteger": "u4", "unsignedlong": "u4"},
    **{"signedbyte": "i1", "signedshort": "i2", "signedinteger": "i4", "signedlong": "i4"},
    **{"float": "f4", "floatvalue": "f4", "double": "f8", "doublevalue": "f8"},
}
#: Exposure times in s by their names in EDF.
EDF_TIMES = ("count_time", "ExposureTime", "acq_expo_time")
#: The ring's current by its names in EDF beside counters.
EDF_CURRENTS = ("machineCurrentStart", "machineCurrent", "machine_current")
#: Parts of the detector, pixels that form one, and how the camera turned them, by their names in
#: EDF.
EDF_REGION = tuple(
    "image_bin image_roi col_beg col_end row_beg row_end col_bin row_bin image_flip "
    "image_rotation".split()
)
EDF_KEYS = (
    Key("Dim_1, Dim_2", "applied"),
    Key("ByteOrder", "applied"),
    Key("DataType", "refused", "numbers", tuple(EDF_TYPES)),
    Key("Dim_3", "refused", "one image per file", (1,)),
    Key("Compression", "refused", "plain numbers", ("none", "nospecificvalue")),
    Key("EDF_BinaryFileName", "refused", "values behind the header"),
    Key("RasterConfiguration", "refused", "rows from the first pixel", (1,)),
    Key("DataValueOffset", "refused", "add it to the values", (0,)),
    Key("Dummy", "refused", "its pixels are bad: replace them, and give views.bad_pixels"),
    Key(", ".join(EDF_TIMES), "compared", "of views and flat fields, as ExposureTime, from s"),
    Key("counter_mne, counter_pos", "compared", "the ring's current srcur, as ExposureTime"),
    Key(", ".join(EDF_CURRENTS), "compared", "as srcur, without that counter"),
    Key(", ".join((*EDF_REGION, "energy")), "compared", "of views and flat fields; warned of"),
    Key("title", "ignored", FREE_TEXT),
    Key("optic_used, PSize_*", "ignored", "the pixel size is asked for"),
    Key("Size, HeaderID, EDF_*, VersionNumber, Image", "ignored", "of the file"),
    Key(
        "Center_*, SampleDistance, WaveLength, motor_mne, motor_pos",
        "ignored",
        "the camera decides",
    ),
    Key(
        "run, scan_*, acq_*, point_no, preset, dir, prefix, suffix, date, time, time_of_*, "
        "machineMode, machineCurrentStop, machineCurrentUnit, cutoffenergy, fill_mode",
        "ignored",
        "of the scan",
    ),
)
HIS_KEYS = (
    Key("FileType, HeaderSize", "applied", "of version 100"),
    Key("ULX, ULY, BRX, BRY", "refused", "equal rows and columns: RTK takes one for the other"),
    Key("ImageHeaderSize, NrOfFrames", "applied"),
    Key("TypeOfNumbers", "refused", "unsigned 16-bit numbers", (4,)),
    Key("IntegrationTime", "ignored", "give it as views.exposure where it changes"),
)
#: Properties of a .xim on which grey values depend: the names of exposures as in DICOM, and others.
XIM_EXPOSURE = {"KVMilliSeconds": "ExposureTime", "KVMilliAmperes": "XRayTubeCurrent"}
XIM_BEAM = (
    *("KVKiloVolts", "KVCollimatorFoil", "KVCollimatorShape", "KVFocalSpot", "MVEnergy"),
    *("ImageMode", "DoseConversionFactor"),
)
XIM_KEYS = (
    Key("PixelWidth, PixelHeight", "applied", "in cm"),
    Key("compression indicator", "refused", "RTK reads packed pixels", (1,)),
    Key("bytes per pixel", "refused", "pixels of 32 bits", (4,)),
    Key("size of the look-up table", "compared", "with rows and columns"),
    Key("KVNormChamber", "compared", "of views and flat fields, as an exposure"),
    Key(
        ", ".join(XIM_EXPOSURE),
        "compared",
        "as ExposureTime and XRayTubeCurrent, where there is no KVNormChamber",
    ),
    Key(", ".join(XIM_BEAM), "compared", "of views and flat fields; warned of"),
    Key("AcquisitionNotes", "ignored", FREE_TEXT),
)
VARIAN_KEYS = (
    Key("SizeX, SizeY", "applied", "(rows - 1) x columns must be a multiple of 4 in .hnd and .xim"),
    Key("dIDUResolutionX, dIDUResolutionY", "applied", "the pixel size in mm"),
    Key("dCTNormChamber", "compared", "of views and flat fields, as an exposure"),
    Key("dXRayMA", "compared", "as XRayTubeCurrent, where there is no dCTNormChamber"),
    Key("dXRayKV", "compared", "of views and flat fields; warned of"),
    Key("nPixelOffset", "ignored", "but for a warning, unless 0"),
    Key("dCTProjectionAngle, dSAD, dSFD, dIDUPosLat", "ignored", "the camera decides"),
)
#: Most bytes of the header of an EDF, which is a multiple of `EDF_BLOCK`.
EDF_HEADER, EDF_BLOCK = 2**16, 512


def rtk_header(file: Path) -> Header:
    """Read the header of a projection by RTK.

    Raises:
        ImportError: itk-rtk is not installed.
        Refused: a key to refuse, several images in an EDF, rows and columns that RTK confuses, or
            more pixels than the file can have.
    """
    form = ENDINGS[file.suffix.lower()]
    kind, sized = PIXELS[form]
    stated: dict[str, list[str]] = {}
    unknown: list[str] = []
    if form == "EDF":
        kind, stated, unknown = _check_edf(file)
    elif form == "HIS":
        _check_his(file)
    elif form == "XIM":
        stated, unknown = _check_xim(file)
    else:
        stated, unknown = _of_varian(file)
    reader = _reader(file)
    reader.UpdateOutputInformation()
    columns, rows, pages = size = tuple(reader.GetOutput().GetLargestPossibleRegion().GetSize())
    right, down, _ = reader.GetOutput().GetSpacing()
    packed = form in ("HND", "XIM")
    if packed and (rows - 1) * columns % 4:
        raise Refused(
            f"{file}: expected (rows - 1) x columns as a multiple of 4, which RTK unpacks, got "
            f"{rows} x {columns} pixels"
        )
    if max(rows, columns) > EDGE:
        raise Refused(f"{file}: expected at most {EDGE} rows and columns, got {rows} x {columns}")
    check_declared(file, size, 1 if packed else np.dtype(kind).itemsize, file, working=4)
    dtype = np.dtype(kind)
    top = None if dtype.kind == "f" else float(np.iinfo(dtype).max)
    pixel = (down, right) if sized else None
    return Header(
        (rows, columns), dtype, pages, frozenset([top]), pixel, stated=stated, unknown=unknown
    )


def rtk_pages(file: Path, first: int, last: int) -> Iterator[np.ndarray]:
    """The images `first` to `last - 1` of a file."""
    reader = _reader(file)
    reader.Update()
    values = _itk(file).array_from_image(reader.GetOutput())[first:last]
    if PIXELS[ENDINGS[file.suffix.lower()]][0] == "i4":  # whose sign RTK takes for a bit
        values = np.where(values >= 2.0**31, values - np.float32(2.0**32), values)
    yield from values


def _reader(file: Path) -> Any:
    itk = _itk(file)
    form = ENDINGS[file.suffix.lower()].title()  # RTK itself does not recognise .HND
    io = getattr(itk, f"{form}ImageIO").New(FileName=str(file))
    reader = itk.ProjectionsReader[itk.Image[itk.F, 3]].New(FileNames=[str(file)], ImageIO=io)
    reader.ComputeLineIntegralOff()
    return reader


def _itk(file: Path) -> Any:
    itk = io_library("itk", file, "rtk")
    if not hasattr(itk, "RTK"):
        raise ImportError(f"{file}: needs itk-rtk: pip install 'mvrecon[rtk]'")
    return itk


def _check_edf(file: Path) -> tuple[str, dict[str, list[str]], list[str]]:
    """The type of the pixels, the exposure by the names in the header, and keys that mvrecon does
    not know; raises Refused for `EDF_KEYS` to refuse.
    """
    with file.open("rb") as raw:
        text = raw.read(EDF_HEADER)
    ends = [n for n in range(EDF_BLOCK, len(text) + 1, EDF_BLOCK) if text[n - 2 : n] == b"}\n"]
    if not ends:
        raise Refused(f"{file}: expected a header of EDF in blocks of {EDF_BLOCK} bytes, got none")
    pairs = (part.partition("=") for part in text[: ends[0]].decode("latin-1").split(";")[:-1])
    stated = {
        name.rpartition("\n")[2].strip("{ \t\r").lower(): value.strip()
        for name, sign, value in pairs
        if sign
    }
    check_keys(file, EDF_KEYS, lambda name: stated.get(name.lower()))
    kind = EDF_TYPES[stated.get("datatype", "missing").lower()]
    needed = int(stated["dim_1"]) * int(stated["dim_2"]) * np.dtype(kind).itemsize
    behind = file.stat().st_size - ends[0] - needed
    if not 0 <= behind < EDF_BLOCK:
        raise Refused(
            f"{file}: expected one image of {needed} bytes, got {needed + behind} behind the header"
        )
    counters = dict(
        zip(*(stated.get(f"counter_{end}", "").split() for end in ("mne", "pos")), strict=False)
    )
    times = {name: stated[name.lower()] for name in EDF_TIMES if stated.get(name.lower())}
    numbers = (number_of(text, f"{file}: {name}") for name, text in times.items())
    exposed = {f"{1000 * time:.6g}" for time in numbers if time is not None}
    currents = [counters.get("srcur", ""), *(stated.get(name.lower(), "") for name in EDF_CURRENTS)]
    current = next(filter(None, currents), "").split() or [""]
    texts = {"ExposureTime": " or ".join(sorted(exposed)), "srcur": current[0]}
    texts |= {name: stated.get(name, "") for name in (*EDF_REGION, "energy")}
    unknown = unknown_entries(stated, EDF_KEYS) + stated_effects(
        [("title", stated.get("title", ""))]
    )
    return kind, {name: [text] for name, text in texts.items() if text}, unknown


def _check_his(file: Path) -> None:
    with file.open("rb") as raw:
        head = raw.read(68)
    extra, left, top, right, bottom, frames = struct.unpack_from("<10x6H", head)
    number = struct.unpack_from("<H", head, 32)[0]
    check_keys(file, HIS_KEYS, {"TypeOfNumbers": number}.get)
    rows, columns = bottom - top + 1, right - left + 1
    if rows != columns:
        raise Refused(
            f"{file}: expected as many rows as columns, which RTK takes for each other, got {rows} "
            f"x {columns}"
        )
    check_declared(file, (frames, rows, columns), 2, file, len(head) + extra)


def _check_xim(file: Path) -> tuple[dict[str, list[str]], list[str]]:
    """Exposure and beam by the names of properties, and properties that mvrecon does not know and
    that may change values; raises Refused for `XIM_KEYS` to refuse.
    """
    with file.open("rb") as raw:
        head = raw.read(36)
    columns, rows, _, size, packed, table = struct.unpack_from("<12x6i", head)
    values = {"compression indicator": packed, "bytes per pixel": size}
    check_keys(file, XIM_KEYS, values.get)
    expected = -(-(rows - 1) * columns // 4)  # two bits for each pixel behind the first row
    if table != expected:
        raise Refused(
            f"{file}: expected a look-up table of {expected} bytes for {rows} x {columns} pixels, "
            f"got {table}"
        )
    own = _xim_properties(file)
    measured = float(own.get("KVNormChamber") or 0) != 0
    names = {"KVNormChamber": "KVNormChamber"} if measured else XIM_EXPOSURE
    names = names | {name: name for name in XIM_BEAM}
    stated = {new: [own[name]] for name, new in names.items() if own.get(name)}
    others = unknown_names(own, XIM_KEYS)
    unknown = [name for name in others if has_effect(name, own[name], IMAGE_EFFECTS)]
    return stated, unknown + stated_effects([("AcquisitionNotes", own.get("AcquisitionNotes", ""))])


def _of_varian(file: Path) -> tuple[dict[str, list[str]], list[str]]:
    """Exposure and beam that the header of .hnc and .hnd states, none of 0, and an offset."""
    with file.open("rb") as raw:
        head = raw.read(512)
    voltage, current, *_, chamber = struct.unpack_from("<6d", head, 400)
    own = {"dXRayKV": voltage}
    own |= {"dCTNormChamber": chamber} if chamber else {"XRayTubeCurrent": current}
    stated = {name: [f"{value:.9g}"] for name, value in own.items() if value}
    return stated, ["nPixelOffset"] * any(head[160:164])


def _xim_properties(file: Path) -> dict[str, str]:
    """The numbers and texts behind the pixels by their names, without lists."""
    found = {}
    with file.open("rb") as raw:

        def number() -> int:
            return struct.unpack("<i", raw.read(4))[0]

        raw.seek(32)
        raw.seek(number(), os.SEEK_CUR)  # the look-up table
        raw.seek(number() + 4, os.SEEK_CUR)  # the pixels, and their unpacked size
        raw.seek(4 * number(), os.SEEK_CUR)  # the histogram
        for _ in range(number()):
            name, kind = raw.read(number()).decode("latin-1"), number()
            if kind == 0:
                found[name] = str(number())
            elif kind == 1:
                found[name] = f"{struct.unpack('<d', raw.read(8))[0]:.9g}"
            elif (text := raw.read(number())) and kind == 2:
                found[name] = text.decode("latin-1").strip("\0 ")
    return found
