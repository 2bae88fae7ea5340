"""Every key of NIfTI, MetaImage and NRRD that changes values or places is applied, compared or
refused by name.
"""

import re

import nibabel
import numpy as np
import pytest
import torch

from mvrecon.core.files.checks import Refused
from mvrecon.data import itk_headers, nrrd_header
from mvrecon.data.volume_files import read_volume

VALUES = np.arange(24, dtype="f4").reshape(2, 3, 4)  # [z y x]
META = {
    "ObjectType": "Image",
    "NDims": "3",
    "BinaryData": "True",
    "BinaryDataByteOrderMSB": "False",
    "ElementSpacing": "1 2 3",
    "Offset": "10 20 30",
    "TransformMatrix": "1 0 0 0 1 0 0 0 1",
    "DimSize": "4 3 2",
    "ElementType": "MET_FLOAT",
}
NRRD = {
    "type": "float",
    "dimension": "3",
    "space": "right-anterior-superior",
    "sizes": "4 3 2",
    "space directions": "(1,0,0) (0,2,0) (0,0,3)",
    "endian": "little",
    "encoding": "raw",
    "space origin": "(10,20,30)",
}


def meta(path, data="LOCAL", kind="<f4", **keys):
    """A MetaImage, its values behind the header or in a file of their own."""
    lines = [f"{k} = {v}" for k, v in {**META, **keys, "ElementDataFile": data}.items() if v]
    raw = VALUES.astype(kind).tobytes()
    path.write_bytes("\n".join([*lines, ""]).encode() + (raw if data == "LOCAL" else b""))
    if data != "LOCAL":
        path.with_name(data).write_bytes(bytes(16) + raw)
    return path


def nrrd(path, **keys):
    """A NRRD file; underscores in names are blanks."""
    stated = {**NRRD, **{name.replace("_", " "): value for name, value in keys.items()}}
    lines = ["NRRD0005", *(f"{k}: {v}" for k, v in stated.items() if v), "", ""]
    path.write_bytes("\n".join(lines).encode() + VALUES.tobytes())
    return path


def places(path):
    """The values by their places in RAS mm."""
    values, grid = read_volume(path)
    index = torch.stack(torch.meshgrid(*map(torch.arange, values.shape), indexing="ij"), dim=-1)
    at = grid.to_world(index.flip(-1).double()).reshape(-1, 3).round(decimals=4).tolist()
    return {tuple(place): value for place, value in zip(at, values.flatten().tolist(), strict=True)}


def expected(origin=(10, 20, 30), steps=(1, 2, 3), signs=(1, 1, 1)):
    """The places of `VALUES` about a first voxel."""
    found = {}
    for (k, j, i), value in np.ndenumerate(VALUES):
        place = [
            s * (o + d * n) for s, o, d, n in zip(signs, origin, steps, (i, j, k), strict=True)
        ]
        found[tuple(map(float, place))] = float(value)
    return found


LPS = (-1, -1, 1)
APPLIED = {
    "as they are": (meta, {}, expected(signs=LPS)),
    "big endian": (
        meta,
        {"BinaryDataByteOrderMSB": "True", "kind": ">f4"},
        expected(signs=LPS),
    ),
    "cm": (meta, {"DistanceUnits": "cm"}, expected((100, 200, 300), (10, 20, 30), LPS)),
    "um": (
        meta,
        {"DistanceUnits": "um", "ElementSpacing": "1000 2000 3000", "Offset": "10e3 20e3 30e3"},
        expected(signs=LPS),
    ),
    "Position": (meta, {"Offset": "", "Position": "10 20 30"}, expected(signs=LPS)),
    "Origin twice": (meta, {"Origin": "10 20 30"}, expected(signs=LPS)),
    "ElementSize": (meta, {"ElementSpacing": "", "ElementSize": "1 2 3"}, expected(signs=LPS)),
    "a header of 16 bytes": (meta, {"data": "a.raw", "HeaderSize": "16"}, expected(signs=LPS)),
    "a header of any size": (meta, {"data": "a.raw", "HeaderSize": "-1"}, expected(signs=LPS)),
    "an identity": (
        meta,
        {"ElementToIntensityFunctionSlope": "1", "ElementToIntensityFunctionOffset": "0.0"},
        expected(signs=LPS),
    ),
    "RAS": (nrrd, {}, expected()),
    "LPS": (nrrd, {"space": "left-posterior-superior"}, expected(signs=LPS)),
    "LAS": (nrrd, {"space": "LAS"}, expected(signs=(-1, 1, 1))),
    "m": (
        nrrd,
        {
            "space_units": '"m" "m" "m"',
            "space_origin": "(0.01,0.02,0.03)",
            "space_directions": "(0.001,0,0) (0,0.002,0) (0,0,0.003)",
        },
        expected(),
    ),
    "no quantization": (nrrd, {"old_min": "NaN", "oldmax": "nan"}, expected()),
}


@pytest.mark.parametrize("case", APPLIED)
def test_keys_are_applied(case, tmp_path):
    """Values at their places in mm, of MetaImage and NRRD files that are written by hand."""
    write, keys, wanted = APPLIED[case]
    assert places(write(tmp_path / ("a.mha" if write is meta else "a.nrrd"), **keys)) == wanted


OTHER = {
    "ObjectType": "Tube",
    "FileFormatVersion": "1",
    "CenterOfRotation": "1 2 3",
    "BinaryData": "False",
    "encoding": "bzip2",
    "space dimension": "5",
    "sample units": "1/cm",
    "ElementToIntensityFunctionSlope": "2",
    "ElementToIntensityFunctionOffset": "-1000",
    "ElementNumberOfChannels": "2",
    "space": "scanner-xyz",
    "axis maxs": "14 26 36",
    "old min": "0",
    "old max": "1000",
    "data file": "b.raw",
    "0028|1040": "LOG",
    "0028|1041": "-1",
    "0018|7032": "90",
    "0018|7034": "YES",
    "0028|6100": "[]",
    "0008|0068": "FOR PRESENTATION",
    "0028|1054": "OD",
}
#: Those of DICOM are no fields of NRRD, but pairs.
FIELDS = [k.name for k in nrrd_header.NRRD_KEYS if k.use == "refused" and "|" not in k.name]


@pytest.mark.parametrize("key", [k.name for k in itk_headers.META_KEYS if k.use == "refused"])
def test_every_key_of_metaimage_to_refuse_is_refused_by_name(key, tmp_path):
    """A MetaImage with a key that changes its values, which ITK ignores, is refused."""
    with pytest.raises(Refused, match=re.escape(key)):
        read_volume(meta(tmp_path / "a.mha", **{key: OTHER[key]}))


@pytest.mark.parametrize("key", FIELDS)
@pytest.mark.parametrize("blank", [" ", ""])
def test_every_key_of_nrrd_to_refuse_is_refused_by_name(blank, key, tmp_path):
    """A NRRD with a key that changes values or places, which ITK ignores, is refused."""
    with pytest.raises(Refused, match=key):
        read_volume(nrrd(tmp_path / "a.nrrd", **{key.replace(" ", blank): OTHER[key]}))


@pytest.mark.parametrize(
    "keys",
    [
        {"Origin": "10 20 31"},
        {"Position": "0 0 0"},
        {"Rotation": "0 1 0 1 0 0 0 0 1"},
        {"ElementByteOrderMSB": "True"},
    ],
)
def test_a_metaimage_with_two_values_of_one_thing_is_refused(keys, tmp_path):
    """ITK takes one of them."""
    with pytest.raises(Refused, match=f"and {next(iter(keys))}, which state the same"):
        read_volume(meta(tmp_path / "a.mha", **keys))


@pytest.mark.parametrize("size", ["8", "-3", "x", "1000"])
def test_an_impossible_header_size_is_refused(size, tmp_path):
    """A MetaImage whose values would begin inside its header or beyond its file is refused."""
    data = "a.raw" if size == "1000" else "LOCAL"
    with pytest.raises(Refused, match="HeaderSize|declares"):
        read_volume(meta(tmp_path / "a.mha", data, HeaderSize=size))


def nifti(path, sform, qform, zooms=None):
    """A NIfTI whose forms are (affine, code)."""
    image = nibabel.Nifti1Image(VALUES.T, np.eye(4))
    image.header.set_xyzt_units("mm")
    image.set_sform(*sform)
    image.set_qform(*qform)
    if zooms:
        image.header.set_zooms(zooms)
    nibabel.save(image, path)
    return path


AFFINE = np.array([[1.0, 0, 0, 10], [0, 2, 0, 20], [0, 0, 3, 30], [0, 0, 0, 1]])
MOVED = AFFINE + np.array([[0, 0, 0, 5.0]] + [[0.0] * 4] * 3)


def test_sform_and_qform_that_agree_are_accepted(tmp_path):
    for codes in ((1, 1), (2, 1), (0, 1), (1, 0)):
        path = nifti(tmp_path / "a.nii", (AFFINE, codes[0]), (AFFINE, codes[1]))
        assert places(path) == expected()


def test_sform_and_qform_of_one_code_that_differ_are_refused(tmp_path):
    """Two different places in the scanner's world."""
    with pytest.raises(Refused, match=r"qform \(code 1\) that agrees with the sform \(code 1\)"):
        read_volume(nifti(tmp_path / "a.nii", (AFFINE, 1), (MOVED, 1)))


@pytest.mark.parametrize("codes", [(2, 1), (4, 1), (1, 2)])
def test_sform_and_qform_of_two_codes_that_differ_are_reported(codes, tmp_path):
    """The places in two worlds may differ; the sform decides, as in nibabel."""
    path = nifti(tmp_path / "a.nii", (AFFINE, codes[0]), (MOVED, codes[1]))
    with pytest.warns(UserWarning, match="differ by 5 voxels; the sform decides"):
        assert places(path) == expected()


def test_voxel_sizes_that_contradict_the_sform_are_reported(tmp_path):
    path = nifti(tmp_path / "a.nii", (AFFINE, 1), (None, 0), zooms=(1, 2, 4))
    with pytest.warns(UserWarning, match="pixdim that agrees with the sform"):
        assert places(path) == expected()
