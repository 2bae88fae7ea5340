"""Headers of MetaImage (MHA, MHD), checked before ITK reads the values, and what they share with
those of NRRD (`nrrd_header`).
"""

import math
import re
import warnings
import zlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from mvrecon.core.files import checks
from mvrecon.core.files.keys import EFFECTS, FREE_TEXT, Key, check_keys, check_unknown
from mvrecon.core.files.prose import stated_effects

#: Maximum bytes of a header.
HEADER = 2**16
#: What C takes for blanks.
BLANKS = " \t\n\r\v\f"
#: Lengths are mm, which ITK takes all to be: NRRD's and MetaImage's unknown units.
NO_UNIT = ("", "?")
#: ITK's key, of an image that it joined of slices, for the largest difference of their distances
#: from the spacing, and the share of the spacing from which it is a gap, as in a DICOM series.
UNEVEN, GAP = "ITK_non_uniform_sampling_deviation", 0.01
#: DICOM's DerivationDescription and ImageComments.
COPIED_TEXTS = ("0008|2111", "0020|4000")
#: Keys of other formats that ITK copies into MetaImage, and into NRRD as key/value pairs.
COPIED = (
    Key(
        UNEVEN,
        "compared",
        f"with the spacing: refused beyond {GAP:.0%} of it, as slices of a series were missing",
    ),
    Key("0028|1040", "refused", "DICOM's PixelIntensityRelationship", ("LIN",)),
    Key("0028|1041", "refused", "DICOM's PixelIntensityRelationshipSign", (1,)),
    Key("0028|1054", "refused", "DICOM's RescaleType", ("HU", "US", "BQML")),
    Key("0018|7032", "refused", "DICOM's FieldOfViewRotation", (0,)),
    Key("0018|7034", "refused", "DICOM's FieldOfViewHorizontalFlip", ("NO",)),
    Key("0028|6100", "refused", "DICOM's subtraction of a mask"),
    Key("0008|0068", "refused", "DICOM's PresentationIntentType", ("FOR PROCESSING",)),
    Key(", ".join(COPIED_TEXTS), "ignored", FREE_TEXT),
    Key(
        "????|????, scl_slope, scl_inter, xyzt_units, dim[*], dim_info, pixdim[*], datatype, "
        "bitpix, vox_offset, nifti_type, qform_code*, sform_code*, qfac, qoffset_*, quatern_*, "
        "srow_*, toffset, cal_min, cal_max, intent_*, slice_*, descrip, aux_file, "
        "dimension_order, storage_data_type, NRRD_kinds[*], NRRD_centerings[*], NRRD_labels[*], "
        "NRRD_thicknesses[*], NRRD_space, NRRD_content, NRRD_measurement frame",
        "ignored",
        "of DICOM (group and element), NIfTI, MINC and NRRD; ITK applied them",
    ),
    Key("ITK_*, CompressionLevel, Software, Modality", "ignored", "of ITK"),
    Key(
        "DICOM.*, Segmentation_*, Segment*_*, MultiVolume.*, DWMRI_*, vtkMRML*, MITK*, "
        "org_mitk_*, modality",
        "ignored",
        "of 3D Slicer and MITK",
    ),
)
#: Free texts of MetaImage.
META_TEXTS = ("Comment", "Name")
#: Keys of MetaImage (.mha, .mhd), all applied by ITK but where noted. ITK ignores one whose name
#: differs in case or spaces.
META_KEYS = (
    Key("ObjectType", "refused", "", ("Image",)),
    Key("FileFormatVersion", "refused", "newer versions place images by ElementOrigin", (0,)),
    Key("NDims, DimSize", "applied", "three axes; further ones of one voxel are dropped"),
    Key("ElementType, ElementSpacing", "applied"),
    Key(
        "ElementSize",
        "applied",
        "where there is no ElementSpacing, else compared with it (a warning), unless 1",
    ),
    Key("ElementNBits", "compared", "with ElementType"),
    Key("Offset", "applied", "of the first voxel's centre"),
    Key("Position, Origin, ImagePosition, ElementOrigin", "compared", "other names of Offset"),
    Key("TransformMatrix", "applied", "rows of unit length"),
    Key("Rotation, Orientation, ElementDirection", "compared", "other names of TransformMatrix"),
    Key(
        "AnatomicalOrientation",
        "compared",
        "with TransformMatrix, as the sides from or towards which the axes run (a warning), and "
        "refused where that is missing",
    ),
    Key("CenterOfRotation", "refused", "add its shift to Offset", (0,)),
    Key("BinaryData", "refused", "numbers, not text", ("True", "T", 1)),
    Key("BinaryDataByteOrderMSB", "applied"),
    Key("ElementByteOrderMSB", "compared", "another name of BinaryDataByteOrderMSB"),
    Key("CompressedData", "applied"),
    Key("CompressedDataSize", "compared", "with the values, which are inflated to their end"),
    Key("DistanceUnits", "applied", "by mvrecon, to mm"),
    Key("HeaderSize", "applied", "of a file with values alone, as bytes before them"),
    Key("ElementToIntensityFunctionSlope", "refused", "store the values it gives", (1,)),
    Key("ElementToIntensityFunctionOffset", "refused", "store the values it gives", (0,)),
    Key("ElementNumberOfChannels", "refused", "one number per voxel", (1,)),
    Key(
        "ElementDataFile",
        "applied",
        "LOCAL, or one file in the header's folder or below; no LIST or pattern",
    ),
    Key(
        "ElementMin, ElementMax, SequenceID, ID, ParentID, Color, AcquisitionDate",
        "ignored",
        "statistics and origin",
    ),
    Key(", ".join(META_TEXTS), "ignored", FREE_TEXT),
    Key("ObjectSubType, TransformType", "ignored", "of other objects than images"),
    *COPIED,
)
#: Numbers of a key of MetaImage, as a power of the number of axes.
COUNTS = {
    **dict.fromkeys(("ElementNBits", "HeaderSize", "CompressedDataSize"), 0),
    **dict.fromkeys(("DimSize", "ElementSpacing", "ElementSize", "CenterOfRotation"), 1),
    **dict.fromkeys(("Offset", "Position", "Origin", "ImagePosition", "ElementOrigin"), 1),
    **dict.fromkeys(("TransformMatrix", "Rotation", "Orientation", "ElementDirection"), 2),
}
#: Numbers of axes: three, further ones of one voxel, as ITK reads them, or the two of a view.
AXES = ("2", "3", "4", "5")
#: Keys of MetaImage that state one thing. ITK ignores the last of three or more.
REPEATED = (
    ("Offset", "Position", "Origin", "ImagePosition", "ElementOrigin"),
    ("TransformMatrix", "Rotation", "Orientation", "ElementDirection"),
    ("BinaryDataByteOrderMSB", "ElementByteOrderMSB"),
)
#: Words of unknown keys that change values or places; see `EFFECTS`. ITK does not apply the units
#: and quantization of an NRRD, but copies them.
META_EFFECTS = {
    **EFFECTS,
    "angle|euler|rotat|tilt|shear|direction|quaternion|matrix|affine|transform|translat|origin|"
    "axes|(?<!patient)(?<!patient_)(?<!com)(orient|position)": 0,
    "spacing|(voxel|pixel).?size|^skip|data.?offset": None,
    "unit(?!y)": ("mm", "millimeter", "millimeters", "millimetre", "millimetres"),
    "^NRRD_old": math.nan,
}
#: MetaImage's types, and numpy's.
META_TYPES = {
    **{"MET_CHAR": "i1", "MET_SHORT": "i2", "MET_INT": "i4", "MET_LONG": "i4"},
    **{"MET_UCHAR": "u1", "MET_USHORT": "u2", "MET_UINT": "u4", "MET_ULONG": "u4"},
    **{"MET_LONG_LONG": "i8", "MET_ULONG_LONG": "u8", "MET_FLOAT": "f4", "MET_DOUBLE": "f8"},
}
#: Least cosine between an oblique axis and the side that names it, which need not be the nearest:
#: where two axes are near one side, ITK names only one of them by it.
MIN_SIDE_COSINE = 0.25
#: The truth by the first letters that ITK accepts.
TRUTH = {"true": True, "t": True, "1": True, "false": False, "f": False, "0": False}


class Header(NamedTuple):
    """A checked header: the file of the values, their first byte in it, their encoding, the bytes
    to skip once they are decoded (-1: all but the last ones), the unit of length in mm, the bytes
    of compressed values, if stated, the text of `UNEVEN`, and the unit of the values, "" of none.
    """

    data: Path
    first: int
    encoding: str
    skip: int
    mm: float
    packed: int | None = None
    uneven: str = "0"
    unit: str = ""


def meta_header(path: Path, text: str) -> Header:
    entries, first = _meta_entries(path, text)
    check_keys(path, META_KEYS, entries.get)
    numbers = _counted(path, entries)
    if (kind := entries.get("ElementType", "")) not in META_TYPES:
        raise checks.Refused(
            f"{path}: expected an ElementType of {', '.join(META_TYPES)}, got {checks.shown(kind)}"
        )
    bits = 8 * np.dtype(META_TYPES[kind]).itemsize
    if numbers.get("ElementNBits", [bits]) != [bits]:
        raise checks.Refused(
            f"{path}: expected the ElementNBits {bits} of {kind}, got {entries['ElementNBits']}"
        )
    flags = {
        name: _truth(path, name, entries[name])
        for name in ("CompressedData", "BinaryDataByteOrderMSB", "ElementByteOrderMSB")
        if name in entries
    }
    _check_repeated(path, entries, {**numbers, **flags})
    _check_axes(path, entries, numbers)
    size, spacing = (numbers.get(name) for name in ("ElementSize", "ElementSpacing"))
    filler = size is None or {*size} == {1.0}  # of writers that state the spacing alone
    if not filler and spacing and not np.allclose(size, spacing, 1e-6, 1e-9):
        warnings.warn(
            f"{path}: expected an ElementSize as its ElementSpacing {entries['ElementSpacing']}, "
            f"got {entries['ElementSize']}; ElementSpacing decides, as in ITK",
            stacklevel=2,
        )
    local, name = entries["ElementDataFile"].lower() == "local", entries["ElementDataFile"]
    if not local and (name.startswith("LIST") or "%" in name):
        raise checks.Refused(
            f"{path}: expected LOCAL or one file as ElementDataFile, got {checks.shown(name)}; "
            f"join its files"
        )
    data = path if local else checks.file_beside(path, checks.decoded(name.encode("latin-1")))
    skipped, packed = int(numbers.get("HeaderSize", [0])[0]), flags.get("CompressedData", False)
    if skipped < (0 if packed else -1) or (skipped > 0 and local):
        raise checks.Refused(
            f"{path}: expected a HeaderSize of a file with values alone, got {skipped} for {name}"
        )
    start = (first if local else 0) + max(0, skipped)
    stated = numbers.get("CompressedDataSize")
    if packed and local and stated is None:
        raise checks.Refused(
            f"{path}: expected a CompressedDataSize, got none: ITK would leave values undefined"
        )
    mm = unit_of_length(path, [entries.get("DistanceUnits", "")], "DistanceUnits")
    size = None if stated is None else int(stated[0])
    encoding, uneven = "gzip" if packed else "raw", entries.get(UNEVEN, "0")
    return Header(data, start, encoding, min(0, skipped), mm, size, uneven)


def _meta_entries(path: Path, text: str) -> tuple[dict[str, str], int]:
    """Keys and texts of a MetaImage's header as ITK splits it, and the bytes of the header."""
    known = [name for key in META_KEYS for name in key.names]
    entries: dict[str, str] = {}
    pairs: list[tuple[str, str]] = []
    place = 0
    while "ElementDataFile" not in entries:
        line, end, _ = text[place:].partition("\n")
        place += len(line) + len(end)
        found = _pair(line)
        last = found is not None and found[0] == "ElementDataFile"  # may end with the file
        if not (end or last) or not (found or not line.strip()):
            raise checks.Refused(
                f"{path}: expected a MetaImage header of lines such as 'DimSize = 4 3 2' with "
                f"ElementDataFile last, got {checks.shown(line)}"
            )
        if found is None:
            continue
        name, value = found
        pairs.append((name, value))
        if name in known and entries.setdefault(name, value) != value:
            raise checks.Refused(
                f"{path}: expected one {name}, got {checks.shown([entries[name], value])}"
            )
    rest = "" if entries["ElementDataFile"].lower() == "local" else text[place:]
    behind = [pair for pair in map(_pair, rest.split("\n")) if pair]
    used = {name for key in META_KEYS if key.use != "ignored" for name in key.names}
    if hidden := [name for name, _ in behind if name in used]:
        raise checks.Refused(
            f"{path}: expected ElementDataFile last, got {hidden[0]} behind it, which ITK ignores"
        )
    texts = [(name, value) for name, value in pairs if name in (*META_TEXTS, *COPIED_TEXTS)]
    check_unknown(path, pairs + behind, META_KEYS, META_EFFECTS, stated_effects(texts))
    return entries, place


def _pair(line: str) -> tuple[str, str] | None:
    """Key and value of a line of a MetaImage's header as ITK splits it."""
    sign = re.search("[=:]", line)
    if sign is None or "\r" in line.strip(BLANKS):
        return None
    return line[: sign.start()].strip(BLANKS), line[sign.start() :].lstrip("=: \t").strip(BLANKS)


def _counted(path: Path, entries: Mapping[str, str]) -> dict[str, list[float]]:
    """The numbers of the keys of `COUNTS`."""
    if (axes := entries.get("NDims", "")) not in AXES:
        raise checks.Refused(f"{path}: expected three axes (NDims 3), got {checks.shown(axes)}")
    numbers = {}
    for name, power in COUNTS.items():
        if name not in entries:
            continue
        count, found = int(axes) ** power, finite(entries[name].split())
        if len(found) != count or len(entries[name].split()) != count:
            raise checks.Refused(
                f"{path}: expected {count} finite numbers for {name}, got "
                f"{checks.shown(entries[name])}"
            )
        numbers[name] = found
    spacing = "ElementSpacing" if "ElementSpacing" in numbers else "ElementSize"
    if 0 in numbers.get(spacing, []):
        raise checks.Refused(f"{path}: expected a {spacing} beyond 0, got {entries[spacing]}")
    return numbers


def finite(words: Sequence[str]) -> list[float]:
    """The finite numbers among words, as both C and Python read them."""
    plain = [float(w) for w in words if re.fullmatch(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?", w)]
    return [value for value in plain if math.isfinite(value)]


def _truth(path: Path, name: str, text: str) -> bool:
    if text.lower() not in TRUTH:
        raise checks.Refused(f"{path}: expected {name} True or False, got {checks.shown(text)}")
    return TRUTH[text.lower()]


def _check_repeated(path: Path, entries: Mapping[str, str], values: Mapping[str, Any]) -> None:
    """Raise for a MetaImage header that states one thing by several names in several ways."""
    for names in REPEATED:
        stated = [name for name in names if name in values]
        if len(names) > 2 and stated == [names[-1]]:
            raise checks.Refused(
                f"{path}: expected {names[0]} beside {stated[0]}, which ITK ignores, got none"
            )
        if any(not np.allclose(values[name], values[stated[0]], 1e-6, 1e-9) for name in stated):
            raise checks.Refused(
                f"{path}: expected one value of {' and '.join(stated)}, which state the same, got "
                f"{checks.shown([entries[name] for name in stated])}"
            )


def _check_axes(path: Path, entries: Mapping[str, str], numbers: Mapping[str, Any]) -> None:
    """Check the directions of a MetaImage's axes, and their names."""
    stated = next((numbers[name] for name in REPEATED[1] if name in numbers), None)
    n = int(entries["NDims"])
    axes = np.eye(3) if stated is None else np.reshape(stated, (n, n))[:3, :3]
    if (lengths := np.linalg.norm(axes, axis=1)).min() < 0.999 or lengths.max() > 1.001:
        raise checks.Refused(
            f"{path}: expected a TransformMatrix with rows of length 1, got lengths "
            f"{lengths.round(4).tolist()}; ElementSpacing has the voxel size"
        )
    name = entries.get("AnatomicalOrientation", "").upper()
    if not re.fullmatch("[RLAPIS]{3}", name):
        return
    named = [divmod("LRPASI".index(side), 2) for side in name]  # its axis in LPS, and the sign
    cosines = [axes[n, k] * (1 - 2 * away) for n, (k, away) in enumerate(named)]
    alike = min(cosines) > MIN_SIDE_COSINE or max(cosines) < -MIN_SIDE_COSINE
    if alike and len({k for k, _ in named}) == 3:
        return
    largest = np.abs(axes).argmax(axis=1)
    sides = [("RL", "AP", "IS")[k][int(axes[n, k] > 0)] for n, k in enumerate(largest)]
    towards, away = "".join(sides), "".join("LRPASI"["RLAPIS".index(side)] for side in sides)
    message = (
        f"{path}: expected the AnatomicalOrientation {away} (axes from) or {towards} (towards) of "
        f"its TransformMatrix, got {name}"
    )
    if stated is None:
        raise checks.Refused(f"{message}; state the axes by TransformMatrix")
    warnings.warn(f"{message}; TransformMatrix decides", stacklevel=2)


def check_length(path: Path, header: Header, needed: int, itemsize: int) -> None:
    """Raise unless the file holds as many values as the header declares: others have another type
    or begin elsewhere, and ITK leaves values undefined where CompressedDataSize is too small.
    """
    if header.skip < 0:
        return
    if header.encoding == "raw":
        got = header.data.stat().st_size - header.first
    elif header.encoding == "gzip":
        used, got = _inflated(header, needed + header.skip)
        if header.packed not in (None, used):
            raise checks.Refused(
                f"{path}: expected the CompressedDataSize {used} of its values, got {header.packed}"
            )
    else:
        words = header.data.read_bytes()[header.first :].replace(b",", b" ").split()
        got = len(words) * itemsize if header.encoding == "text" else len(b"".join(words)) // 2
    if got != needed + header.skip:
        raise checks.Refused(
            f"{path}: expected {needed} bytes of values, as its header declares, got "
            f"{got - header.skip}; is it cut short, or do other bytes come first (HeaderSize, byte "
            f"skip)?"
        )


def check_even(path: Path, header: Header, spacing_mm: float) -> None:
    """Raise for an image that ITK joined of slices at other distances than its spacing."""
    uneven = finite([header.uneven])
    if not uneven or uneven[0] * header.mm > GAP * spacing_mm:
        raise checks.Refused(
            f"{path}: expected slices {spacing_mm:g} mm apart, got {UNEVEN} "
            f"{checks.shown(header.uneven)}: slices were missing when ITK joined them; read the "
            f"DICOM series itself, or remove the key where they are even"
        )


def _inflated(header: Header, most: int) -> tuple[int, int]:
    """Bytes of a stream of zlib or gzip, and of its values, of which it reads a few beyond
    `most`.
    """
    used, count, stream = 0, 0, zlib.decompressobj(47)
    with header.data.open("rb") as file:
        file.seek(header.first)
        while not stream.eof and count <= most:
            block = stream.unconsumed_tail or file.read(2**20)
            if not block:
                raise ValueError("its compressed values have no end")
            used += 0 if stream.unconsumed_tail else len(block)
            count += len(stream.decompress(block, 2**24))
    return used - len(stream.unused_data), count


def unit_of_length(path: Path, texts: Sequence[str], names: str) -> float:
    """Unit of length of a header in mm."""
    where = f"{path}: {names}"
    mm = {1.0 if text in NO_UNIT else checks.millimetres(where, text) for text in texts}
    if len(mm) > 1:
        raise checks.Refused(
            f"{path}: expected one unit of length for all axes, got "
            f"{checks.shown(sorted(set(texts)))} as {names}; convert the lengths, or remove it "
            f"where they are mm"
        )
    return mm.pop()
