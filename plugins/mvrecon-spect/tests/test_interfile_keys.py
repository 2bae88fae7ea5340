"""Every key of Interfile that changes values or places is applied, compared or refused by name."""

import errno
import os
import re
import warnings
from pathlib import Path

import numpy as np
import pytest
import torch

from mvrecon.core.files.checks import Refused
from mvrecon.data.projections.opening import open_projections
from mvrecon.geometry.grid import Grid
from mvrecon_spect.files.interfile_keys import CONTENT, KEYS
from mvrecon_spect.files.interfile_views import InterfileViews
from mvrecon_spect.files.interfile_volume import read_interfile, write_interfile_volume

VALUES = np.arange(24, dtype=">f4").reshape(4, 3, 2)
#: Headers of STIR's recon_test_pack, with other sizes: test_image_3.hv, PinholeSPECTUB/attmap.hv
#: and PinholeSPECTUB/org/FBP.hv.
IMAGE = """!INTERFILE  :=
name of data file := a.v
!GENERAL DATA :=
!GENERAL IMAGE DATA :=
!type of data := PET
imagedata byte order := BIGENDIAN
!PET STUDY (General) :=
!PET data type := Image
process status := Reconstructed
!number format := float
!number of bytes per pixel := 4
number of dimensions := 3
matrix axis label [1] := x
!matrix size [1] := 2
scaling factor (mm/pixel) [1] := 2.5
matrix axis label [2] := y
!matrix size [2] := 3
scaling factor (mm/pixel) [2] := 2.5
matrix axis label [3] := z
!matrix size [3] := 4
scaling factor (mm/pixel) [3] := 5
number of time frames := 1
image scaling factor[1] := 1
data offset in bytes[1] := 0
quantification units := 1
!END OF INTERFILE :=
"""
ATTMAP = """!INTERFILE :=
!imaging modality := CT
!originating system := GATE
!version of keys := 3.3

!GENERAL DATA :=
patient orientation := head_in
patient rotation :=  prone
!data offset in bytes := 0
!name of data file := a.v

!GENERAL IMAGE DATA :=
!type of data := Tomographic
imagedata byte order := BIGENDIAN

!SPECT STUDY (general) :=
!process status := reconstructed
!number format := float
!number of bytes per pixel := 4
number of dimensions := 3
matrix axis label [1] := x
matrix axis label [2] := y
matrix axis label [3] := z
!matrix size [1] := 2
!matrix size [2] := 3
!matrix size [3] := 4
scaling factor (mm/pixel) [1] := 2.5
scaling factor (mm/pixel) [2] := 2.5
scaling factor (mm/pixel) [3] := 5

!END OF INTERFILE :=
"""
#: As examples/samples/SPECT_Interfile_header.hs and PinholeSPECTUB/input.hs of STIR.
VIEWS = """!INTERFILE  :=
!imaging modality := nucmed
name of data file := a.v
!version of keys := 3.3
!GENERAL DATA :=
!GENERAL IMAGE DATA :=
!type of data := Tomographic
imagedata byte order := BIGENDIAN
!SPECT STUDY (General) :=
!number format := float
!number of bytes per pixel := 4
!number of projections := 4
!extent of rotation := 360
!maximum pixel count := 23
process status := acquired
!SPECT STUDY (acquired data):=
!direction of rotation := CW
start angle := 180
orbit := Circular
Radius := 150
!matrix size [1] := 2
!scaling factor (mm/pixel) [1] := 3.32
!matrix size [2] := 3
!scaling factor (mm/pixel) [2] := 6.64
!END OF INTERFILE :=
"""


def read(folder: Path, header: str, *lines: str) -> np.ndarray:
    """The values of a header of STIR's, in which lines replace those of the same key or are added
    before the end.
    """
    kept = header.strip().splitlines()
    for line in lines:
        key = line.partition(":=")[0].strip("! ").lower()
        kept = [old for old in kept if old.partition(":=")[0].strip("! ").lower() != key]
        kept.insert(-1, line)
    path = folder / ("a.hs" if header is VIEWS else "a.hv")
    path.write_text("\n".join(kept))
    VALUES.tofile(folder / "a.v")
    if header is VIEWS:
        return InterfileViews(path).read(0, len(VALUES)).numpy()
    return read_interfile(path, place="centred")[0].numpy()


#: Of Interfile 3.3, without a third axis, as XMedCon writes it.
SLICES = """!INTERFILE :=
!imaging modality := nucmed
!originating system := (X)MedCon
!version of keys := 3.3
!GENERAL DATA :=
!data starting block := 0
!name of data file := a.v
data compression := none
data encode := none
!GENERAL IMAGE DATA :=
!type of data := Tomographic
!total number of images := 4
imagedata byte order := BIGENDIAN
number of energy windows := 1
flood corrected := Y
!SPECT STUDY (general) :=
number of detector heads := 1
!number of images/energy window := 4
!process status := Reconstructed
!matrix size [1] := 2
!matrix size [2] := 3
!number format := short float
!number of bytes per pixel := 4
scaling factor (mm/pixel) [1] := +2.5
scaling factor (mm/pixel) [2] := +2.5
!number of projections := 4
!extent of rotation := 360
!time per projection (sec) := 1
patient orientation := head_in
patient rotation := supine
!SPECT STUDY (reconstructed data) :=
!number of slices := 4
slice orientation := Transverse
slice thickness (pixels) := +2
centre-centre slice separation (pixels) := +2
oblique reconstruction := N
!END OF INTERFILE :=
"""


def test_a_volume_of_interfile_without_a_third_axis_has_that_of_its_slices(tmp_path):
    """Their number, and their separation in pixels. Also tried: without the separation, with a
    third axis that contradicts them, and with a thickness that does.
    """
    assert np.array_equal(read(tmp_path, SLICES), VALUES)
    volume, grid = read_interfile(tmp_path / "a.hv")
    assert np.array_equal(volume, VALUES) and grid.spacing == (2.5, 2.5, 5.0)
    for line in (
        "centre-centre slice separation (pixels) :=",
        "!matrix size [3] := 5",
        "slice thickness (pixels) := 1.5",
        "scaling factor (mm/pixel) [3] := 4",
        "!number of slices := 3",
    ):
        with pytest.raises(Refused, match=r"separation|thickness|number of"):
            read(tmp_path, SLICES, line)


@pytest.mark.parametrize("encoding", ["latin-1", "utf-8", "utf-8-sig"])
@pytest.mark.parametrize("folder", ["", "./", "{}/"])
def test_a_header_of_another_encoding_with_the_path_of_its_data_is_read(encoding, folder, tmp_path):
    """Names in Latin-1, a byte order mark, and the path of the data as GATE writes it; the data of
    a folder that is not below are refused, also where a file beside the header has their name.
    """
    text = SLICES.replace(":= a.v", f":= {folder.format(tmp_path)}ä.v")
    text = text.replace("!GENERAL DATA :=", "patient name := Müller")
    VALUES.tofile(tmp_path / "ä.v")
    (tmp_path / "a.hv").write_bytes(text.encode(encoding))
    assert np.array_equal(read_interfile(tmp_path / "a.hv")[0], VALUES)
    for other in ("/data/a.v", "../a.v", f"{tmp_path}/other/a.v", "."):
        (tmp_path / "a.hv").write_bytes(SLICES.replace(":= a.v", f":= {other}").encode(encoding))
        with pytest.raises(Refused, match="in its folder or below"):
            read_interfile(tmp_path / "a.hv")


def test_a_header_without_its_end_is_read_with_a_warning(tmp_path):
    """Some programs leave out the last line. A header that ends within a line is refused, as are
    keys behind the end.
    """
    VALUES.tofile(tmp_path / "a.v")
    path, whole = tmp_path / "a.hv", SLICES.replace("!END OF INTERFILE :=\n", "")
    path.write_text(whole)
    with pytest.warns(UserWarning, match="no '!END OF INTERFILE :=' .* 'oblique reconstruction'"):
        assert np.array_equal(read_interfile(path)[0], VALUES)
    for text in (whole[:-1], f"{SLICES}image scaling factor := 2\n", whole.partition("\n")[2]):
        path.write_text(text)
        with pytest.raises(Refused, match="is it cut short"):
            read_interfile(path)


def test_the_geometry_of_gate_s_head_is_no_key_of_the_views(tmp_path):
    """The lines of GATE's GateToInterfile, older versions of which do not write them as comments;
    other lengths beside them are refused.
    """
    lines = [
        f"head {axis} {word} (cm) := 4" for axis in "xyz" for word in ("dimension", "translation")
    ]
    lines += ["head material := Air", "crystal x dimension (cm) := 1.5", "number of runs := 32"]
    assert np.array_equal(read(tmp_path, VIEWS, "GATE GEOMETRY :=", *lines), VALUES)
    with pytest.raises(Refused, match="crystal x translation"):
        read(tmp_path, VIEWS, *lines, "crystal x translation (cm) := 3")


@pytest.mark.parametrize("ending", ["hs", "h00", "h33", "hdr", "HDR"])
def test_headers_of_projections_have_the_endings_of_several_programs(ending, tmp_path):
    """STIR's .hs, SIMIND's .h00 and GATE's .hdr, which other formats use as well."""
    path = tmp_path / f"a.{ending}"
    path.write_text(VIEWS)
    VALUES.tofile(tmp_path / "a.v")
    stack = open_projections(path)
    assert stack.kind == "counts" and np.array_equal(stack.read(0, len(VALUES)), VALUES)
    path.write_text("ENVI\nsamples = 2\nlines = 3\nbands = 4\n")
    with pytest.raises(Refused, match="expected an Interfile header"):
        open_projections(path)


def test_texts_that_state_what_was_done_to_counts_are_named(tmp_path):
    """Not those of the study."""
    read(tmp_path, VIEWS, "data description := rest, supine", "comment := 64 projections")
    lines = ["comment := counts scaled by 1000", "data description := scatter corrected"]
    for line in lines:
        with pytest.warns(UserWarning, match=line.replace(" :=", ":")):
            read(tmp_path, VIEWS, line)


SCALES = {
    "none": ([], 1),
    "image scaling factor": (["image scaling factor[1] := 2"], 2),
    "without index": (["image scaling factor := 0.25"], 0.25),
    "quantification units": (["quantification units := 3"], 3),
    "with index": (["quantification units [1] := 3"], 3),
    "index 01": (["image scaling factor [01] := 2"], 2),
    "STIR's blanks": (["  image__scaling !factor[ 1 ] := 2"], 2),
    "continued line": (["image scaling factor[1] := \\\n 2"], 2),
    "both alike": (["image scaling factor[1] := 2.5", "quantification units := 2.5"], 2.5),
    "identities": (["data rescale slope := 1", "data rescale offset := 0"], 1),
}


@pytest.mark.parametrize("header", [IMAGE, ATTMAP, VIEWS])
@pytest.mark.parametrize("scale", SCALES)
def test_values_are_scaled(scale: str, header: str, tmp_path: Path):
    """STIR's rule of quantification units: the image scaling factor, or equal to it."""
    lines, factor = SCALES[scale]
    if header is IMAGE and lines:  # may also have the other
        header = header.replace("image scaling factor[1] := 1\n", "")
        header = header.replace("quantification units := 1\n", "")
    assert np.array_equal(read(tmp_path, header, *lines), factor * VALUES.astype("f4"))


CONTRADICTIONS = [
    ["image scaling factor[1] := 2", "quantification units := 3"],
    ["image scaling factor[1] := 2", "image scaling factor := 3"],
    ["image scaling factor[1] := {1, 2, 3, 4}"],
    ["quantification units := Bq/ml"],
    ["data offset in bytes := 0", "data starting block := 1"],
    ["total number of images := 5"],
    ["number of images/window := 5"],
    ["imagedata byte order := BIGENDIAN", "image data byte order := LITTLEENDIAN"],
    ["image scaling factor[1] := 0"],
    ["quantification units := 0"],
]


@pytest.mark.parametrize("header", [IMAGE, ATTMAP, VIEWS])
@pytest.mark.parametrize("lines", CONTRADICTIONS)
def test_keys_that_contradict_each_other_are_refused(lines, header: str, tmp_path: Path):
    """Interfile headers with two scales, a list of scales, a scale of 0, two offsets, byte orders
    or numbers of images are refused by the key.
    """
    name = lines[-1].partition("[")[0].partition(" :=")[0]
    with pytest.raises(Refused, match=name.replace("image data", "imagedata")):
        read(tmp_path, header, *lines)


def test_a_starting_block_is_an_offset(tmp_path: Path):
    header = tmp_path / "a.hv"
    lines = ATTMAP.replace("!data offset in bytes := 0", "!data starting block := 1")
    header.write_text(lines)
    (tmp_path / "a.v").write_bytes(bytes(2048) + VALUES.tobytes())
    assert np.array_equal(read_interfile(header)[0].numpy(), VALUES.astype("f4"))


def refused(content: str) -> list[str]:
    """Names of the keys to refuse of a content."""
    return [k.name for k in (*KEYS, *CONTENT[content]) if k.use == "refused"]  # type: ignore[index]


@pytest.mark.parametrize(
    ("header", "key"),
    [(ATTMAP, key) for key in refused("volume")] + [(VIEWS, key) for key in refused("projections")],
)
def test_every_key_to_refuse_is_refused_by_name(header: str, key: str, tmp_path: Path):
    """Interfile headers with a key of another meaning than values as stored are refused."""
    with pytest.raises(Refused, match=rf"expected (no )?{key.replace('[', '.').replace(']', '.')}"):
        read(tmp_path, header, f"{key} := 7")


@pytest.mark.parametrize(
    "line",
    [
        "scale factor := 2",
        "%rescale factor := 2",
        "pixel value offset := 10",
        "calibration factor (Bq/ml) := 3",
        "image data units := Bq/ml",
        "scale factor (cm/pixel) [1] := 4",
        "data compression method := gzip",
    ],
)
@pytest.mark.parametrize("header", [ATTMAP, VIEWS])
def test_an_unknown_key_of_scale_place_or_unit_is_refused(header: str, line: str, tmp_path: Path):
    """Interfile headers with an unknown key whose name states an effect are refused by that key."""
    with pytest.raises(Refused, match="expected keys whose effect is known, got"):
        read(tmp_path, header, line)


@pytest.mark.parametrize("header", [IMAGE, ATTMAP, VIEWS])
def test_keys_of_patient_and_study_are_ignored(header: str, tmp_path: Path):
    lines = ["patient name := a", "study date := 2020:01:01", "isotope name := ^99m^Technetium"]
    lines += ["image duration (sec)[1] := 600", "flood corrected := N", "; scale factor := 2"]
    assert np.array_equal(read(tmp_path, header, *lines), VALUES.astype("f4"))


BOTH = [
    "%image scaling factor := 2",
    "%image scaling factor[1] := 1",
    "% quantification units := 2",
    "%quantification units[1] := 2",
    "%rescale slope := 2",
    "NUD/rescale slope := +2.000000e+00",
    "NUD/rescale intercept := -1.000000e+03",
    "%image slope := 2",
    "%x-offset (mm) := 3.0",
    "gain corrected := 1",
    "log scale := 1",
    "log10 scale := 1",
    "%data offset in bytes := 0",
    "%imagedata byte order := LITTLEENDIAN",
    "%number format := signed integer",
    "%matrix size [1] := 3",
    "image scaling factor[2] := 2",
    "image scaling factor[0] := 2",
    "image scaling factor[a] := 2",
    "image scaling factor[1][2] := 2",
    "image scaling factor[1 := 2",
    "quantification units[2] := 2",
    "quantification units[02] := 2",
    "data offset in bytes[2] := 0",
    "data rescale slope[1] := 2",
    "DATA_RESCALE_SLOPE [ 01 ] := 2",
    "rescale intercept[1] := 2",
    "data compression[1] := gzip",
    "data encode[1] := uuencode",
    "number of time frames[1] := 2",
    "number of energy windows[1] := 2",
    "number of detector heads[1] := 2",
    "energy window lower level[2] := 100",
    "image duration (sec)[2] := 100",
    "type of data[1] := dynamic",
    "number of bytes per pixel[1] := 2",
    "originating system[1] := mvrecon",
    "matrix size := 2",
    "matrix size [4] := 2",
    "matrix axis label := z",
    "matrix axis label [4] := segment",
    "scaling factor (mm/pixel) := 2",
    "scaling factor (mm/pixel) [1][1] := 2",
    "gain := 2",
    "%gain[1] := 2",
    "multiplier := 2",
    "image multiplication := 2",
    "normalisation := 2",
    "normalization := 2",
    "scatter correction := Y",
    "attenuation correction := Y",
    "decay correction := start",
    "%decay correction factor := 2",
    "dead time corrected := Y",
    "background subtraction := Y",
    "pixel bias := 2",
    "image origin := {1, 2, 3}",
    "first voxel position (mm) [1] := 2",
    "timeframes := 2",
    "number of time frame := 2",
    "type of dat := dynamic",
    "typeofdata := dynamic",
    "matrix axis labels [1] := z",
    "imagescalingfactor := 2",
    "byte order := LITTLEENDIAN",
    "bits per pixel := 12",
    "voxel size := 2",
    "axis order := zyx",
    "row major := N",
    "head first := N",
    "data type := int16",
    "header length := 512",
    "angular step := 3",
    "x translation := 3",
    "volume centre (mm) := 3",
    "pixel pitch (mm) := 2",
    "log := Y",
    "SUV := Y",
    "divide by := 2",
    "rebinned := 2",
    "padding value := -1",
    "gantry tilt := 10",
    "patient orientation := feet_in",
    "patient rotation := left",
    "camera zoom factor := 2",
    "image scaling factor[1] = 2",
    "image scaling factor[1] : 2",
    "image scaling factor : = 2",
]
OF_VOLUMES = [
    "calibration factor[1] := 2",
    "%calibration factor := 2",
    "%first pixel offset (mm) [1] := 5",
    "first pixel offset (mm) := 5",
    "first pixel offset (mm) [4] := 5",
    "first pixel offset (mm) [0] := 5",
    "first pixel offset [1] := 5",
    "first pixel offset (cm) [1] := 5",
    "centre-centre slice separation (pixels)[1] := 3",
    "%centre-centre slice separation (pixels) := 2",
    "centre-centre slice separation (pixels) := 3",
    "center-center slice separation (pixels) := 3",
    "Center-Center_slice separation := 3",
    "slice thickness (pixels) := 3",
    "slice spacing (mm) := 3",
    "slice orientation[1] := coronal",
    "%slice orientation := coronal",
    "oblique reconstruction := Y",
    "number of slices := 5",
    "number of slices[1] := 4",
    "process status[1] := acquired",
    "PET data type[1] := emission",
]
OF_VIEWS = [
    "x offset[1] := 2",
    "%x offset := 2",
    "X_offset [1] := 0",
    "y offset[2] := 2",
    "decay corrected[1] := Y",
    "%decay corrected := Y",
    "attenuation corrected[1] := Y",
    "%scatter corrected := Y",
    "applied corrections[1] := {scatter}",
    "%applied corrections := {scatter}",
    "method of scatter correction := TEW",
    "orbit[1] := non-circular",
    "%orbit := non-circular",
    "orbit[a] := non-circular",
    "radii[1] := 150",
    "radius[1] := 100",
    "%radius := 100",
    "radius (cm) := 10",
    "process status[1] := reconstructed",
    "%process status := reconstructed",
    "start angle[1] := 10",
    "%start angle := 10",
    "direction of rotation[1] := CCW",
    "number of projections[1] := 4",
    "%number of projections := 4",
    "matrix size [3] := 5",
    "scaling factor (mm/pixel) [3] := 2",
    "Centre_of_rotation := For every angle",
    "center of rotation := every",
    "preprocessed := Y",
    "filter name := Butterworth",
    "first pixel offset (mm) [1] := 5",
]
ESCAPES = [
    *((header, line) for header in (IMAGE, ATTMAP, VIEWS) for line in BOTH),
    *((header, line) for header in (IMAGE, ATTMAP) for line in OF_VOLUMES),
    *((VIEWS, line) for line in OF_VIEWS),
]


@pytest.mark.parametrize(("header", "line"), ESCAPES)
def test_no_spelling_of_a_key_escapes_the_table(header: str, line: str, tmp_path: Path):
    """Interfile headers with a key that changes values or places are refused by name, however it is
    spelled: with an index where there is none, without where there is one, of an axis or image that
    does not exist, 0, no number, twice, open; with "%"; with "_" for blanks, without blanks, in
    American; with a slip; with "=" or ":" for ":="; of another unit; or as words of no table.
    """
    key = line.replace("_", " ").strip("% ").lower().removeprefix("nud/")
    base = key.partition(":")[0].partition("=")[0].partition("[")[0].strip()
    with pytest.raises(Refused) as refused:
        read(tmp_path, header, line)
    assert base.replace("center", "centre") in str(refused.value).lower()


HARMLESS = [
    *("%image slope := 1", "%image intercept := 0.0", "%x-offset (mm) := 0.0"),
    *("NUD/rescale slope := +1.000000e+00", "NUD/rescale intercept := +0.000000e+00"),
    *("%patient orientation := HFS", "collimator thickness := 3.5"),
    "%decay corrected := N",
    "scatter correction := none",
    "%decay correction :=",
    "preprocessed :=",
    "applied corrections := {None}",
    "image data byte order := BIGENDIAN",
    "number of images/energy window := 4",
    "number of dimensions := 3",
    "Centre_of_rotation := Corrected",
    *("camera zoom factor := 1", "zoom := 1.0", "gantry tilt (deg) := 0", "image shift := 0 0"),
    "acquisition mode := stepped",
    "study duration (elapsed) sec : = 320",
    "!maximum pixel count : = 33",
    "GATE GEOMETRY :=",
    "head x dimension (cm) := 30",
    "energy window [1] := Tc-99m",
    "energy window lower level[1] := 126",
    "image duration (sec)[1] := 600",
    "image relative start time (sec)[01] := 0",
    "number of radionuclides := 1",
    "radionuclide name[1] := ^99m^Technetium",
    "radionuclide halflife (sec)[1] := 21624.12",
    "radionuclide branching factor[1] := 0.885",
    "%SMS-MI version number := 3.4",
    "%bucket singles rate [1] := 20606",
    "patient orientation := head_in",
    "patient rotation := supine",
]
OF_RECONSTRUCTIONS = [
    "number of projections := 120",
    "start angle := 180",
    "orbit := non-circular",
    "scatter corrected := Y",
    "method of attenuation correction := Chang",
    "filter name := Butterworth",
    "slice thickness (pixels) := 2.000001",
    "center-center slice separation (pixels) := 2",
    "index nesting level := {data type}",
    "image data type description[1] := activity",
]


@pytest.mark.parametrize(
    ("header", "line"),
    [
        *((header, line) for header in (IMAGE, ATTMAP, VIEWS) for line in HARMLESS),
        *((header, line) for header in (IMAGE, ATTMAP) for line in OF_RECONSTRUCTIONS),
    ],
)
def test_keys_without_effect_are_accepted(header: str, line: str, tmp_path: Path):
    """Keys of STIR 6, GATE, SIMIND, XMedCon and Siemens, with values that change nothing, without a
    warning.
    """
    with warnings.catch_warnings(action="error"):
        assert np.array_equal(read(tmp_path, header, line), VALUES.astype("f4"))


@pytest.mark.parametrize(
    ("line", "name"),
    [
        *((f"{name} := 2", name) for name in ("sharpened", "%secret", "counts", "Bq/ml [2]")),
        *(("kernel = 3", "kernel"), ("keV: 3", "kev")),
        *(("just a remark", "just a remark"), ("slop := 2", "slop")),
    ],
)
@pytest.mark.parametrize("header", [IMAGE, ATTMAP, VIEWS])
def test_other_unknown_keys_are_named(header: str, line: str, name: str, tmp_path: Path):
    """In one warning, also lines that state no key."""
    with pytest.warns(UserWarning, match=f"know: {re.escape(name.lower())}") as found:
        assert np.array_equal(read(tmp_path, header, line), VALUES.astype("f4"))
    assert len(found) == 1


def test_an_image_of_castor_is_read_without_a_warning(tmp_path: Path):
    """Its keys, a dynamic image of one frame, a heading without `:=`, and lines of the input's
    header behind the end.
    """
    lines = [
        *("!type of data := Dynamic", "!number of frame groups := 1", "process status :="),
        *("CASToR version := 3.2", "!STATIC STUDY (General) :=", "!GENERAL IMAGE DATA"),
        *("!number of images in this frame group := 4", "!image start time (sec) := 0"),
        *("pause between frame groups (sec) := 0", "data rescale slope := 1"),
    ]
    read(tmp_path, ATTMAP, *lines)
    path = tmp_path / "a.hv"
    behind = "!COPY OF INPUT HEADER 1\nData type: PET\nScatter correction flag: 0\n"
    path.write_text(f"{path.read_text()}\n{behind}")
    with warnings.catch_warnings(action="error"):
        assert np.array_equal(read_interfile(path)[0], VALUES)


def test_a_volume_of_castor_is_centred_unless_it_is_displaced(tmp_path: Path):
    """CASToR writes offsets of 0 into every header; others displace the volume, and are refused:
    along each axis, along all, and with the sign of STIR's origin.
    """
    offsets = [f"first pixel offset (mm) [{axis}] := 0" for axis in (1, 2, 3)]
    lines = ["CASToR version := 3.1", *offsets]
    read(tmp_path, ATTMAP, *lines)
    with warnings.catch_warnings(action="error"):
        values, grid = read_interfile(tmp_path / "a.hv")
    assert np.array_equal(values, VALUES) and grid.centre.tolist() == [0.0, 0.0, 0.0]
    for axis, shift in ((0, 20), (1, -2.5), (2, 5)):
        displaced = [*offsets]
        displaced[axis] = displaced[axis].replace(":= 0", f":= {shift}")
        read(tmp_path, ATTMAP, lines[0], *displaced)
        with pytest.raises(Refused, match="CASToR, where it displaces the volume"):
            read_interfile(tmp_path / "a.hv")


def test_headings_and_origins_of_other_programs_are_read_without_a_warning(tmp_path: Path):
    """Of GATE, SIMIND and (X)MedCon."""
    lines = [
        *("date of keys := 1992:01:01", "program author := M Ljungberg", "exam type := STATIC"),
        *("original institution := a", "contact person := b", "!study ID := c", "patient sex := M"),
        *("!static study (each frame) :=", "!image number := 1", "label := View1"),
        *("GATE SIMULATION :=", "crystal material := NaI", "number of runs := 32"),
        *("conversion program := (X)MedCon", "study time := 09:40:47"),
    ]
    for header in (SLICES, ATTMAP, VIEWS):
        with warnings.catch_warnings(action="error"):
            assert np.array_equal(read(tmp_path, header, *lines), VALUES)


@pytest.mark.parametrize("header", [IMAGE, ATTMAP])
def test_the_voxel_size_is_read_as_siemens_spells_it(header: str, tmp_path: Path):
    read(tmp_path, header)
    spelled = header.replace("scaling factor (mm/pixel)", "scale factor (mm/pixel)")
    (tmp_path / "b.hv").write_text(spelled)
    assert read_interfile(tmp_path / "b.hv")[1].spacing == (2.5, 2.5, 5.0)


@pytest.mark.parametrize(
    "key", ["imagedata byte order", "image data byte order", "!IMAGEDATA_byte order"]
)
def test_a_byte_order_is_read_as_either_program_spells_it(key: str, tmp_path: Path):
    """Interfile's spelling and Siemens'; big endian is the default."""
    header = ATTMAP.replace("imagedata byte order := BIGENDIAN\n", "")
    assert np.array_equal(read(tmp_path, header), VALUES.astype("f4"))
    swapped = read(tmp_path, header, f"{key} := LITTLEENDIAN")
    assert np.array_equal(swapped, VALUES.view("<f4"))


def test_numbers_that_are_repeated_are_equal_to_the_last_image(tmp_path: Path):
    """One image of thousands, which is less than the tolerance of a ratio."""
    grid = Grid.centred(size=(1, 1, 2000), spacing=1.0)
    write_interfile_volume(tmp_path / "a.hv", torch.ones(2000, 1, 1), grid)
    text = (tmp_path / "a.hv").read_text()
    for key in ("number of slices", "total number of images"):
        (tmp_path / "a.hv").write_text(text.replace("!END", f"{key} := 2001\n!END"))
        with pytest.raises(Refused, match=f"{key}' 2000"):
            read_interfile(tmp_path / "a.hv")


@pytest.mark.parametrize("full", ["a.v", "a.hv"])
def test_a_full_disk_keeps_the_earlier_header_and_its_values(full, tmp_path, monkeypatch):
    """Values of the new volume with the header of the old one, which has other voxels, would be
    read without a word; whichever of the two files is the one that does not fit.
    """
    old, new = (Grid.centred(4, spacing=s) for s in (1.0, 2.0))
    write_interfile_volume(tmp_path / "a.hv", torch.ones(old.shape), old)
    fsync = os.fsync

    def sync(descriptor):
        if Path(os.readlink(f"/proc/self/fd/{descriptor}")).name.startswith(f".{full}."):
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        fsync(descriptor)

    monkeypatch.setattr(os, "fsync", sync)
    with pytest.raises(OSError, match="No space left"):
        write_interfile_volume(tmp_path / "a.hv", torch.full(new.shape, 2.0), new)
    monkeypatch.undo()
    values, grid = read_interfile(tmp_path / "a.hv")
    assert (values == 1).all() and grid.spacing == old.spacing
    assert {path.name for path in tmp_path.iterdir()} == {"a.hv", "a.v"}
