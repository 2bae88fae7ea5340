"""Every field of NIfTI that changes values or places is applied, compared or refused by name."""

import warnings

import nibabel
import numpy as np
import pytest
import torch

from mvrecon.core.files.checks import Refused
from mvrecon.data.volume_files import read_volume

VALUES = np.arange(24, dtype="f4").reshape(4, 3, 2)  # [x y z]
AFFINE = np.array([[1.0, 0, 0, 10], [0, 2, 0, 20], [0, 0, 3, 30], [0, 0, 0, 1]])
#: Texts of a header, and extensions by their codes, with what a warning names.
STATED = {
    "a slope": ({"descrip": b"slope=2"}, [], "descrip"),
    "a factor": ({"descrip": b"scale factor 0.5"}, [], "descrip"),
    "a unit": ({"descrip": b"units: Bq/ml"}, [], "descrip"),
    "1/cm": ({"intent_name": b"mu in 1/cm"}, [], "intent_name"),
    "cm^-1": ({"descrip": b"attenuation (cm^-1)"}, [], "descrip"),
    "an offset": ({"aux_file": b"offset=-1000"}, [], "aux_file"),
    "a comment": ({}, [(6, b"rescale slope: 2")], "comment"),
    "an unknown code": ({}, [(4, b"<AFNI scale=2>"), (98, b"x")], "extension of code 98"),
    "FSL": ({"descrip": b"6.0.5:9e026117"}, [], ""),
    "SPM": ({"descrip": b"SPM{T_[15.0]} - contrast 1: a"}, [], ""),
    "dcm2niix": ({"descrip": b"TE=2.9;Time=113046.875;phase=1"}, [], ""),
    "AFNI": ({}, [(4, b"<AFNI_attributes scale=2>"), (6, b"by hand")], ""),
    "an identity": ({"descrip": b"slope=1;offset=0"}, [], ""),
}


@pytest.mark.parametrize("case", STATED)
@pytest.mark.parametrize("kind", ["Nifti1Image", "Nifti2Image"])
@pytest.mark.parametrize("order", ["<", ">"])
def test_texts_that_may_state_a_factor_or_a_unit_are_named(order, kind, case, tmp_path):
    """Of a header of either byte order and version, packed or not; ordinary ones are not."""
    fields, extensions, name = STATED[case]
    header = getattr(nibabel, kind).header_class(endianness=order)
    image = getattr(nibabel, kind)(VALUES, AFFINE, header)
    for field, text in fields.items():
        image.header[field] = text
    image.header.extensions.extend(nibabel.nifti1.Nifti1Extension(*one) for one in extensions)
    nibabel.save(image, tmp_path / "a.nii.gz")
    with warnings.catch_warnings(record=True) as found:
        warnings.simplefilter("always")
        read_volume(tmp_path / "a.nii.gz")
    assert [name in str(one.message) for one in found] == [True] * bool(name)


SFORM, QFORM, NEITHER = {"qform_code": 0}, {"sform_code": 0}, {"sform_code": 0, "qform_code": 0}


def written(path, fields, kind="f4", extra=b""):
    """A NIfTI of `VALUES` whose forms both give `AFFINE`, with other fields."""
    image = nibabel.Nifti1Image(VALUES.astype(kind), AFFINE, dtype=kind)
    image.header.set_xyzt_units("mm")
    image.set_sform(AFFINE, 1)
    image.set_qform(AFFINE, 1)
    raw = image.to_bytes()
    header = nibabel.Nifti1Header(raw[:348], check=False)
    for name, value in fields.items():
        header[name] = value
    path.write_bytes(header.binaryblock + raw[348:] + extra)
    return path


def pixdim(*values):
    return {"pixdim": np.array([*values, 1, 1, 1, 1], "f4")}


READ = {
    "nan as no slope": ({"scl_slope": np.nan, "scl_inter": np.nan}, 1, 0),
    "no slope": ({"scl_slope": 0, "scl_inter": 0}, 1, 0),
    "an intercept without a slope": ({"scl_slope": 0, "scl_inter": 5}, 1, 0),
    "a negative slope": ({"scl_slope": -2, "scl_inter": 1}, -2, 1),
    "an intercept": ({"scl_slope": 1, "scl_inter": -1024}, 1, -1024),
    "time": ({"xyzt_units": 2 + 24, "toffset": 5}, 1, 0),
    "slices": ({"dim_info": 57, "slice_code": 1, "slice_end": 1, "intent_code": 1002}, 1, 0),
    "display": ({"cal_min": 5, "cal_max": 7}, 1, 0),
    "no hand": ({**QFORM, **pixdim(0, 1, 2, 3)}, 1, 0),
    "a fourth axis of 1": ({"dim": [4, 4, 3, 2, 1, 1, 1, 1]}, 1, 0),
    "further axes of 0 or 1": ({"dim": [7, 4, 3, 2, 0, 0, 1, 0]}, 1, 0),
    "entries behind the axes": ({"dim": [3, 4, 3, 2, 5, 0, 0, 0]}, 1, 0),
}


@pytest.mark.parametrize("kind", ["i2", "u8", "f8"])
@pytest.mark.parametrize("case", READ)
def test_fields_are_applied_without_a_word(case, kind, tmp_path):
    """Values are slope times stored number plus intercept (none for a slope of 0, by the standard,
    or nan, as nibabel writes), at the places of the forms.
    """
    fields, slope, intercept = READ[case]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        values, grid = read_volume(written(tmp_path / "a.nii", fields, kind))
    assert torch.equal(values, torch.from_numpy(slope * VALUES.T + intercept))
    assert torch.equal(grid.affine, torch.from_numpy(AFFINE))


@pytest.mark.parametrize(("code", "mm"), [(0, 1.0), (1, 1e3), (2, 1.0), (3, 1e-3)])
def test_units_of_length_are_those_of_the_code(code, mm, tmp_path):
    grid = read_volume(written(tmp_path / "a.nii", {"xyzt_units": code + 16}))[1]
    assert grid.spacing == pytest.approx((mm, 2 * mm, 3 * mm))


def test_the_hand_of_the_qform_is_applied(tmp_path):
    """pixdim[0] = -1 reverses the third axis."""
    values, grid = read_volume(written(tmp_path / "a.nii", {**QFORM, **pixdim(-1, 1, 2, 3)}))
    assert grid.affine[2, 3] == 27 and torch.equal(
        values.flip(0), torch.from_numpy(VALUES.T.copy())
    )


REFUSED = {
    "an infinite slope": ("scl_slope", {"scl_slope": np.inf}),
    "an intercept of nan": ("scl_inter", {"scl_slope": 2, "scl_inter": np.nan}),
    "an infinite intercept": ("scl_inter", {"scl_slope": 1, "scl_inter": np.inf}),
    "an intercept beside nan": ("scl_inter", {"scl_slope": np.nan, "scl_inter": 5}),
    "an unknown unit": ("xyzt_units", {"xyzt_units": 4}),
    "unknown bits of units": ("xyzt_units", {"xyzt_units": 64 + 2}),
    "an unset place of the values": ("vox_offset", {"vox_offset": 0}),
    "values in the header": ("vox_offset", {"vox_offset": 348}),
    "part of a byte": ("vox_offset", {"vox_offset": 352.5}),
    "no number of bytes": ("vox_offset", {"vox_offset": np.nan}),
    "bits of another type": ("bitpix", {"bitpix": 8}),
    "an unknown type": ("datatype", {"datatype": 7}),
    "single bits": ("datatype|data code", {"datatype": 1, "bitpix": 1}),
    "a voxel of 0 mm": ("pixdim", {**QFORM, **pixdim(1, 0, 2, 3)}),
    "a voxel of nan mm": ("pixdim", {**QFORM, **pixdim(1, 1, np.nan, 3)}),
    "a negative voxel": ("pixdim", {**QFORM, **pixdim(1, 1, 2, -3)}),
    "an infinite voxel": ("pixdim", {**NEITHER, **pixdim(1, np.inf, 2, 3)}),
    "a voxel of 0 mm without forms": ("pixdim", {**NEITHER, **pixdim(1, 1, 0, 3)}),
    "a negative voxel beside the sform": ("pixdim", {**SFORM, **pixdim(1, -1, 2, 3)}),
    "no hand": (r"pixdim\[0\]", {**QFORM, **pixdim(2, 1, 2, 3)}),
    "a hand of nan": (r"pixdim\[0\]", pixdim(np.nan, 1, 2, 3)),
    "a long quaternion": ("quatern", {**QFORM, "quatern_b": 2}),
    "a quaternion of nan": ("quatern", {**QFORM, "quatern_c": np.nan}),
    "an offset of nan": ("qoffset", {**QFORM, "qoffset_x": np.nan}),
    "an sform of nan": ("srow_x", {**SFORM, "srow_x": [np.nan, 0, 0, 0]}),
    "an unknown sform": ("sform_code", {"sform_code": 9}),
    "a negative sform": ("sform_code", {"sform_code": -1}),
    "an unknown qform": ("qform_code", {"sform_code": 0, "qform_code": 6}),
    "a pair of files": ("magic", {"magic": b"ni1"}),
    "several volumes": (r"\(4, 3, 1, 2\)", {"dim": [4, 4, 3, 1, 2, 1, 1, 1]}),
}


@pytest.mark.parametrize("case", REFUSED)
def test_fields_that_nibabel_repairs_or_ignores_are_refused_by_name(case, tmp_path):
    """nibabel repairs most of these in silence: a first byte of 0 reads the header as values."""
    name, fields = REFUSED[case]
    with pytest.raises(Refused, match=name):
        read_volume(written(tmp_path / "a.nii", fields))


@pytest.mark.parametrize(
    ("fields", "extra", "message"),
    [
        ({**SFORM, **pixdim(1, 1, 2, 0)}, b"", "pixdim that agrees with the sform"),
        ({**SFORM, **pixdim(1, np.nan, 2, 3)}, b"", "pixdim that agrees with the sform"),
        (NEITHER, b"", "neither sform nor qform"),
        ({}, bytes(7), "7 bytes behind the volume"),
        ({"dim": [3, 4, 3, 1, 1, 1, 1, 1]}, b"", "48 bytes behind the volume"),
    ],
)
def test_what_a_header_leaves_open_is_reported(fields, extra, message, tmp_path):
    with pytest.warns(UserWarning, match=message):
        read_volume(written(tmp_path / "a.nii", fields, extra=extra))
