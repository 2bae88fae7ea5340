"""Every key of Interfile that changes values or places is applied, compared or refused by name."""

from pathlib import Path

import numpy as np
import pytest

from mvrecon.core.files.checks import Refused
from mvrecon_spect.files.interfile import CONTENT, KEYS
from mvrecon_spect.files.interfile_views import InterfileViews
from mvrecon_spect.files.interfile_volume import read_interfile

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


SCALES = {
    "none": ([], 1),
    "image scaling factor": (["image scaling factor[1] := 2"], 2),
    "without index": (["image scaling factor := 0.25"], 0.25),
    "quantification units": (["quantification units := 3"], 3),
    "with index": (["quantification units [1] := 3"], 3),
    "both alike": (["image scaling factor[1] := 2.5", "quantification units := 2.5"], 2.5),
    "identities": (["data rescale slope := 1", "data rescale offset := 0"], 1),
}


@pytest.mark.parametrize("header", [IMAGE, ATTMAP, VIEWS])
@pytest.mark.parametrize("scale", SCALES)
def test_values_are_scaled(scale: str, header: str, tmp_path: Path):
    """STIR's rule of quantification units: the image scaling factor, or equal to it."""
    lines, factor = SCALES[scale]
    if header is IMAGE and scale in ("without index", "with index"):  # also has the other
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
]


@pytest.mark.parametrize("header", [IMAGE, ATTMAP, VIEWS])
@pytest.mark.parametrize("lines", CONTRADICTIONS)
def test_keys_that_contradict_each_other_are_refused(lines, header: str, tmp_path: Path):
    """Interfile headers with two scales, a list of scales, two offsets or two numbers of images are
    refused by the key.
    """
    with pytest.raises(Refused, match=lines[-1].partition("[")[0].partition(" :=")[0]):
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
        "scale factor (mm/pixel) [1] := 4",
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
