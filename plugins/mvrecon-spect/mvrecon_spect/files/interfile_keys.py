"""Keys of Interfile headers, and words of unknown keys that change values or places."""

import re
from typing import Literal

from mvrecon.core.files import keys
from mvrecon.core.files.keys import Key

Content = Literal["projections", "volume"]


def _first(*names: str) -> str:
    """Keys that have an index for each image or window of a file, of which there is one."""
    return ", ".join(f"{name}, {name} [1]" for name in names)


def _axes(name: str, count: int = 3) -> str:
    """A key of each axis."""
    return ", ".join(f"{name} [{axis}]" for axis in range(1, count + 1))


NO = ("n", "no", "none", "0")
#: Keys of free texts.
TEXTS = ("data description", "label", "comment", "comments")
#: Keys of a header of any content. Names with and without [1] have one meaning; an index that is
#: not listed is refused, except of ignored keys without any.
KEYS = (
    Key("name of data file", "applied", "beside the header"),
    Key("number format, number of bytes per pixel", "applied"),
    Key("imagedata byte order", "applied", "image data is imagedata; big endian if missing"),
    Key(_first("data offset in bytes"), "applied"),
    Key("data starting block", "compared", "with the offset, which is 2048 bytes per block"),
    Key(_first("image scaling factor"), "applied", "one for all planes"),
    Key(
        _first("quantification units"),
        "applied",
        "as in STIR: the image scaling factor, or equal to it",
    ),
    Key("data rescale slope", "refused", "multiply the values by it", (1,)),
    Key("data rescale offset", "refused", "add it to the values", (0,)),
    Key("rescale slope", "refused", "multiply the values by it", (1,)),
    Key("rescale intercept", "refused", "add it to the values", (0,)),
    Key("number of time frames", "refused", "one frame in a file", (1,)),
    Key("number of frame groups", "refused", "one frame in a file", (1,)),
    Key("number of time windows", "refused", "one window in a file", (1,)),
    Key("number of energy windows", "refused", "one window in a file", (1,)),
    Key("number of windows", "refused", "one window in a file", (1,)),
    Key("number of image data types", "refused", "one type in a file", (1,)),
    Key("number of detector heads", "refused", "join the heads' projections", (1,)),
    Key("data compression", "refused", "plain numbers", ("none",)),
    Key("data encode", "refused", "plain numbers", ("none",)),
    Key("type of data", "refused", "", ("tomographic", "static", "dynamic", "pet", "other")),
    Key("camera zoom factor", "refused", "the scaling factors state the pixels", (1,)),
    Key("originating system", "applied", "mvrecon: every offset is a position"),
    Key("castor version", "applied", "CASToR: an offset of 0 is that of a centred volume"),
    Key("imaging modality, version of keys", "ignored", "origin"),
    Key(
        "patient orientation",
        "refused",
        "no world has these axes; without the key they are the scanner's",
        ("head_in", "head in", "hfs", "hfp", "unknown"),
    ),
    Key(
        "patient rotation",
        "refused",
        "no world has these axes; without the key they are the scanner's",
        ("supine", "prone", "unknown"),
    ),
    Key("maximum pixel count, minimum pixel count", "ignored", "statistics"),
    Key(_first("energy window"), "ignored", "of the physics"),
    Key(
        _first("energy window lower level", "energy window upper level"),
        "compared",
        "with the widths_kev of a scatter estimate",
    ),
    Key(
        _first("image duration (sec)"),
        "applied",
        "of scatter from another file, whose counts are scaled to that of the views",
    ),
    Key(
        _first("time per projection (sec)"),
        "applied",
        "the duration of a view; compared with the image duration, that of all views or of one",
    ),
    Key("study duration (sec)", "ignored", "may include pauses"),
    Key(_first("image relative start time (sec)"), "ignored", "one image in a file"),
    Key(_first("image data type description"), "ignored", "one type in a file"),
    Key(
        "number of radionuclides, radionuclide branching factor, isotope branching factor, "
        "number of cardiac cycles (observed), number of cardiac cycles (acquired)",
        "ignored",
        "of the study",
    ),
    Key(
        "start horizontal bed position (mm), end horizontal bed position (mm), "
        "start vertical bed position (mm)",
        "ignored",
        "as in STIR's projectors",
    ),
    Key("flood corrected, uniformity corrected", "ignored", "as cameras do"),
    Key(
        "general data, general image data, gate geometry, spect study (general), "
        "spect study (acquired data), spect study (reconstructed data)",
        "ignored",
        "headings",
    ),
    Key(
        "date of keys, conversion program, program author, program version, program date, "
        "original institution, contact person, date last processed, time last processed, "
        "archive status, patient name, patient id, patient dob, patient sex, patient age, "
        "patient height, patient weight, study id, study date, study time, study description, "
        "exam type, process label, sms-mi version number, sms-mi header name space, "
        "bucket singles rate",
        "ignored",
        "origin",
    ),
    Key(", ".join(TEXTS), "ignored", keys.FREE_TEXT),
    Key(
        "isotope, isotope name, isotope gamma halflife (sec), radionuclide, radionuclide name, "
        "radionuclide halflife (sec), radiopharmaceutical, dosage, collimator, collimator name, "
        "collimator type, collimator thickness, collimator hole diameter, energy resolution, "
        "reference energy (in keV), head material, crystal material, acquisition mode, "
        "study duration (elapsed) sec, image start time, image start time (sec), "
        "pause between images (sec), pause between frame groups (sec)",
        "ignored",
        "of the study",
    ),
    Key(
        "image number, frame group number, number of images this frame group, "
        "number of images in this frame group, maximum pixel count in group, index nesting level, "
        "total counts, data format",
        "ignored",
        "one image in a file, and statistics",
    ),
    Key(
        ", ".join(
            f"{part} {axis} dimension (cm)" for part in ("head", "crystal") for axis in "xyz"
        ),
        "ignored",
        "GATE's, of the simulated head",
    ),
    Key(
        ", ".join(["number of runs", *(f"head {axis} translation (cm)" for axis in "xyz")]),
        "ignored",
        "GATE's, of the simulated head",
    ),
)
#: Keys of one content besides `KEYS`.
CONTENT: dict[Content, tuple[Key, ...]] = {
    "projections": (
        Key("number of projections", "applied"),
        Key("number of dimensions", "refused", "rows and columns of each view", (2, 3)),
        Key(_axes("matrix size", 2), "applied"),
        Key(
            _axes("scaling factor (mm/pixel)", 2),
            "applied",
            "of STIR's pinhole systems; compared with the pixel size of other cameras",
        ),
        Key(
            "matrix size [3], total number of images, number of images/window, "
            "number of images/energy window",
            "compared",
            "with the number of projections",
        ),
        Key("matrix axis label [1]", "refused", "", ("bin coordinate",)),
        Key("matrix axis label [2]", "refused", "", ("axial coordinate",)),
        Key("matrix axis label [3]", "refused", "", ("view",)),
        Key("process status", "refused", "measured views", ("acquired",)),
        Key("preprocessed", "refused", "measured views", NO),
        Key("PET data type", "refused", "counts", ("emission",)),
        Key("decay corrected", "refused", "counts as measured", NO),
        Key("attenuation corrected", "refused", "counts as measured", NO),
        Key("scatter corrected", "refused", "counts as measured", NO),
        Key("applied corrections", "refused", "counts as measured", ("none", "{none}", "{}")),
        Key(
            "direction of rotation, start angle, first projection angle in data set",
            "compared",
            "with a ring of STIR's detector file; programs differ in the zero and the direction",
        ),
        Key(
            "extent of rotation",
            "compared",
            "as they are; also with the steps of other cameras, either way round",
        ),
        Key("orbit", "refused", "", ("circular",)),
        Key("radius", "applied", "of STIR's pinhole systems"),
        Key("radii", "refused", "circular orbit"),
        Key(
            "centre of rotation",
            "refused",
            "centred detectors",
            ("corrected", "single_value", "single value"),
        ),
        Key("x offset", "refused", "centred detectors", (0,)),
        Key("y offset", "refused", "centred detectors", (0,)),
        Key("calibration factor", "ignored", "of activities; views are counts"),
    ),
    "volume": (
        Key("number of dimensions", "refused", "x, y, z", (3,)),
        Key(_axes("matrix size"), "applied", "without [3] number of slices"),
        Key(
            _axes("scaling factor (mm/pixel)"),
            "applied",
            "without [3] the centre-centre slice separation, in pixels of [1]",
        ),
        Key("matrix axis label [1]", "refused", "", ("x",)),
        Key("matrix axis label [2]", "refused", "", ("y",)),
        Key("matrix axis label [3]", "refused", "", ("z",)),
        Key(
            "number of slices, total number of images, number of images/window, "
            "number of images/energy window",
            "compared",
            "with matrix size [3]",
        ),
        Key(
            "centre-centre slice separation (pixels), slice thickness (pixels)",
            "compared",
            "with the scaling factors [3] and [1]; center is centre",
        ),
        Key(_axes("first pixel offset (mm)"), "applied", "unless place=centred"),
        Key("slice orientation", "refused", "x, y, z", ("transverse",)),
        Key("oblique reconstruction", "refused", "x, y, z", NO),
        Key("process status", "refused", "a volume", ("reconstructed",)),
        Key("PET data type", "refused", "a volume", ("image",)),
        Key("calibration factor", "refused", "multiply the values by it", (1, 0, -1)),
        Key(
            "decay corrected, attenuation corrected, scatter corrected, applied corrections, "
            "method of attenuation correction, attenuation correction coefficient/cm, "
            "method of scatter correction, method of reconstruction, filter name, "
            "filter parameters, z-axis filter, "
            "number of iterations, number of subsets, number of reference frame",
            "ignored",
            "of the reconstruction; values are as stored",
        ),
        Key(
            "number of projections, direction of rotation, start angle, extent of rotation, "
            "first projection angle in data set, orbit, radius, centre of rotation",
            "ignored",
            "of the acquisition",
        ),
    ),
}
#: Words of unknown keys that change values or places.
EFFECT = re.compile(
    r"scal|slope|intercept|factor|multipl|divisor|calibrat|quanti|normali|sensitivit|efficienc|"
    r"offset|exponent|logarithm|correct|decay|attenuat|scatter|dead ?time|subtract|background|"
    r"smooth|filter|compress|encod|interleav|endian|byte|format|truncat|look.?up|"
    r"interpolat|recovery|weighting|divide|padding|skip|block|mask|rebin|binning|mashing|"
    r"transpos|mirror|invert|revers|magnif|rotat|clockwise|orient|direction|translat|ang(le|ul)|"
    r"separation|spacing|distance|pitch|(?<!collimator )thickness|width|"
    r"number of|centre of|centre \(|frame|windows|heads|(head|feet) first|header (length|size)|"
    r"(data|sample|pixel|voxel) type|"
    r"\b(gains?|bias|log|power|complex|suv|units?|origins?|shift\w*|positions?|zoom\w*|flip\w*|"
    r"tilt\w*|clip\w*|orders?|major|bits?|signed|sizes?|orbits?|arc|radius|radii|axis|axes|gates|"
    r"dimensions)\b"
)
#: Values of such a key that change nothing, by its words: 1 of slopes, 0 of offsets; see
#: `mvrecon.core.files.keys.EFFECTS`.
EFFECTS = {
    EFFECT.pattern: None,
    **keys.EFFECTS,
    "zoom|magnif|binning|mashing": 1,
    r"tilt|\bshift|rotat|translat|invert|revers": 0,
    r"\blog|\bpower|correct|number of": None,
}
#: Other spellings of known keys: American, Siemens', and (X)MedCon's of the group "NUD/".
SPELLINGS = {
    "center": "centre",
    "image data byte order": "imagedata byte order",
    "scale factor (mm/pixel)": "scaling factor (mm/pixel)",
    "nud/": "",
}
#: Keys that repeat the number of images of a file.
IMAGES = ("total number of images", "number of images/window", "number of images/energy window")
#: Numbers of sections of a header; each section repeats its keys.
SECTIONS = (
    "number of detector heads",
    "number of energy windows",
    "number of windows",
    "number of time frames",
    "number of time windows",
    "number of frame groups",
    "number of image data types",
)
