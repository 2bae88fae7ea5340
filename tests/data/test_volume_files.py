"""Volumes of every format: values stay at their places, in our world (RAS) and ITK's (LPS)."""

import nibabel
import numpy as np
import pytest
import SimpleITK as sitk
import torch

from mvrecon.core.files.checks import Refused
from mvrecon.data.attenuation import WATER, attenuation, hounsfield
from mvrecon.data.volume_files import read_volume, save_volume, volumes_in
from mvrecon.data.volumes import Volumes
from mvrecon.geometry.grid import Grid, voxel_centres
from mvrecon.geometry.rigid import euler_rotation
from tests.data.test_nifti import AFFINES, SIZE, blobs, centred

LPS = torch.tensor([-1.0, -1.0, 1.0], dtype=torch.float64)
FORMATS = ["nii", "nii.gz", "mha", "nrrd"]


def tilted(shape=(4, 6, 5)):
    """A grid of unlike spacings whose axes are turned about all three of the world's."""
    affine = torch.eye(4, dtype=torch.float64)
    turn = euler_rotation([20.0, -15.0, 10.0], "xyz")
    affine[:3, :3] = turn @ torch.diag(torch.tensor([1.5, 2.0, 3.0], dtype=torch.float64))
    affine[:3, 3] = torch.tensor([-12.0, 34.0, 56.0])
    return Grid(shape, affine)


def itk_points(path):
    """World mm in RAS and values of every voxel, as SimpleITK reads the file."""
    image = sitk.ReadImage(str(path))
    places = [
        (x, y, z)
        for z in range(image.GetDepth())
        for y in range(image.GetHeight())
        for x in range(image.GetWidth())
    ]
    xyz = torch.tensor([image.TransformIndexToPhysicalPoint(place) for place in places])
    values = torch.from_numpy(sitk.GetArrayFromImage(image).reshape(-1).astype("f4"))
    return xyz.double() * LPS, values


@pytest.mark.parametrize("ending", FORMATS)
def test_simple_itk_reads_our_volume_at_the_same_positions(ending, tmp_path):
    grid, path = tilted(), tmp_path / f"a.{ending}"
    volume = torch.rand(grid.shape)
    save_volume(path, volume, grid)
    points, values = itk_points(path)
    assert torch.equal(values, volume.flatten())
    assert torch.allclose(points, voxel_centres(grid).reshape(-1, 3), atol=2e-4)
    again, there = read_volume(path)
    assert torch.equal(again, volume)
    assert torch.allclose(there.affine, grid.affine, atol=1e-5)


@pytest.mark.parametrize("packed", [False, True])
@pytest.mark.parametrize("name", ["Röntgen", "日本", "a b", "a(1)", "a;b", "a=b", "12:30"])
def test_the_values_beside_a_header_of_itk_have_any_name(name, packed, tmp_path):
    """ITK writes the name of the .raw or .zraw into the .mhd in UTF-8."""
    values = np.arange(24, dtype="f4").reshape(2, 3, 4)
    sitk.WriteImage(sitk.GetImageFromArray(values), str(tmp_path / f"{name}.mhd"), packed)
    got = read_volume(tmp_path / f"{name}.mhd")[0].flip(1, 2)  # LPS
    assert np.array_equal(got.numpy(), values)


@pytest.mark.parametrize("ending", ["mha", "mhd", "nrrd", "nii.gz"])
def test_what_itk_makes_of_a_nifti_has_its_values(ending, tmp_path):
    """ITK applies slope and intercept, and copies all keys of the header into the new one."""
    image = nibabel.Nifti1Image(np.arange(24, dtype="i2").reshape(4, 3, 2), np.diag([2, 3, 4, 1]))
    image.header.set_slope_inter(2.0, -7.0)
    image.header.set_xyzt_units("mm", "sec")
    image.header["toffset"], image.header["descrip"] = 3.5, b"scale = 2; offset = 5"
    image.to_filename(tmp_path / "a.nii")
    sitk.WriteImage(sitk.ReadImage(str(tmp_path / "a.nii")), str(tmp_path / f"b.{ending}"))
    (expected, grid), (got, there) = (read_volume(tmp_path / n) for n in ("a.nii", f"b.{ending}"))
    assert torch.equal(got, expected) and torch.allclose(there.affine, grid.affine)


@pytest.mark.pairwise(name=AFFINES, ending=["mha", "nrrd", "mhd"])
def test_an_object_in_an_itk_image_has_its_world_position(name, ending, tmp_path):
    affine = centred(AFFINES[name])
    i, j, k = np.meshgrid(*[np.arange(SIZE)] * 3, indexing="ij")
    xyz = np.stack([i, j, k, np.ones_like(i)], axis=-1) @ affine.T
    image = sitk.GetImageFromArray(blobs(torch.from_numpy(xyz[..., :3])).numpy().T)
    lps = np.diag([-1.0, -1, 1, 1]) @ affine
    spacing = np.linalg.norm(lps[:3, :3], axis=0)
    image.SetSpacing(spacing.tolist())
    image.SetDirection((lps[:3, :3] / spacing).flatten().tolist())
    image.SetOrigin(lps[:3, 3].tolist())
    sitk.WriteImage(image, str(tmp_path / f"a.{ending}"), True)
    values, grid = read_volume(tmp_path / f"a.{ending}")
    assert torch.allclose(values.double(), blobs(voxel_centres(grid)), atol=1e-5)
    axes = grid.affine[:3, :3].diagonal()
    assert (axes > 0).all()  # towards right, front and head


@pytest.mark.pairwise(name=AFFINES, source=["nii", "nrrd"], ending=FORMATS)
def test_a_volume_like_another_file_has_its_array_in_other_programs(name, source, ending, tmp_path):
    """With axes flipped, permuted and oblique: nibabel and SimpleITK read the array and the places
    of the voxels that they wrote.
    """
    array, affine = np.random.default_rng(0).random((4, 6, 5), "f4"), centred(AFFINES[name])
    like, out = tmp_path / f"like.{source}", tmp_path / f"out.{ending}"
    image = nibabel.Nifti1Image(array, affine)
    nibabel.save(image, tmp_path / "like.nii")
    sitk.WriteImage(sitk.ReadImage(str(tmp_path / "like.nii")), str(like))
    save_volume(out, *read_volume(like), like=like)
    first, second = (sitk.ReadImage(str(path)) for path in (like, out))
    assert np.array_equal(sitk.GetArrayFromImage(second), array.T)
    for get in ("GetOrigin", "GetSpacing", "GetDirection"):
        assert np.allclose(getattr(second, get)(), getattr(first, get)(), atol=1e-5)
    if ending.startswith("nii"):
        again = nibabel.load(out)
        assert np.array_equal(again.get_fdata(dtype="f4"), array)
        assert np.allclose(again.affine, affine, atol=1e-5)
    with pytest.raises(ValueError, match="like.*expected the voxels of the written volume"):
        save_volume(out, torch.zeros(4, 6, 5), tilted(), like=like)


def test_a_nifti_header_says_mm_and_has_both_forms(tmp_path):
    grid = tilted()
    save_volume(tmp_path / "a.nii", torch.zeros(grid.shape), grid)
    header = nibabel.load(tmp_path / "a.nii").header
    assert header.get_xyzt_units()[0] == "mm"
    assert (int(header["sform_code"]), int(header["qform_code"])) == (1, 1)
    for form in (header.get_sform(), header.get_qform()):
        assert np.allclose(form, grid.affine.numpy(), atol=1e-4)


def test_a_sheared_grid_is_kept_by_nifti_and_refused_by_itk(tmp_path):
    affine = torch.eye(4, dtype=torch.float64)
    affine[0, 1] = 0.3
    grid = Grid((2, 3, 4), affine)
    save_volume(tmp_path / "a.nii", torch.zeros(grid.shape), grid)
    assert torch.allclose(read_volume(tmp_path / "a.nii")[1].affine, affine, atol=1e-6)
    assert int(nibabel.load(tmp_path / "a.nii").header["qform_code"]) == 0
    with pytest.raises(ValueError, match="voxel axes at right angles.*NIfTI keeps it"):
        save_volume(tmp_path / "a.mha", torch.zeros(grid.shape), grid)
    assert [file.name for file in tmp_path.iterdir()] == ["a.nii"]


def test_hounsfield_units_round_trip_through_attenuation():
    hu = torch.linspace(-1000, 3000, 401, dtype=torch.float64)
    assert torch.allclose(hounsfield(attenuation(hu)), hu, atol=1e-9)
    assert hounsfield(torch.tensor([0.0, WATER])).tolist() == [-1000, 0]


@pytest.mark.parametrize("ending", ["mha", "nrrd"])
def test_a_truncated_itk_image_is_refused(ending, tmp_path):
    """An MHA or NRRD volume that is cut short is refused with its name, wherever it is cut."""
    path = tmp_path / f"a.{ending}"
    save_volume(path, torch.rand(4, 6, 5), tilted())
    whole = path.read_bytes()
    for part in (0.99, 0.8, 0.5, 0.1, 0.0):
        path.write_bytes(whole[: int(part * len(whole))])
        with pytest.raises(Refused, match=rf"a\.{ending}: "):
            read_volume(path)


def test_an_nrrd_header_that_would_end_the_process_or_hides_its_end_is_refused(tmp_path):
    """An NRRD header with a line that ITK would write beyond its buffer, with an end that only some
    programs see, or without one is refused; long comments and key/value pairs are read.
    """
    path = tmp_path / "a.nrrd"
    save_volume(path, torch.rand(4, 6, 5), tilted())
    values = read_volume(path)[0]
    header, _, data = path.read_bytes().partition(b"\n\n")
    for added, message in (
        (b"kinds: " + b"A" * 1000, "lines of at most 500 characters"),
        (b"a:=" + b"A" * 1000 + b": 1", "lines of at most 500 characters"),
        (b"\x85\x85\ndata file: /etc/passwd", "its values in the same file"),
        (b"#" + b"A" * 2**16, "header of at most 65536 bytes"),
    ):
        path.write_bytes(header + b"\n" + added + b"\n\n" + data)
        with pytest.raises(Refused, match=rf"a\.nrrd: expected .*{message}"):
            read_volume(path)
    path.write_bytes(header + b"\n#" + b"A" * 1000 + b"\na:=" + b"A" * 1000 + b"\n\n" + data)
    assert torch.equal(read_volume(path)[0], values)


def test_itk_images_that_are_not_volumes_are_refused(tmp_path):
    """An ITK image of two axes, of colours, or that declares more than it holds is refused."""
    path = tmp_path / "a.mha"
    sitk.WriteImage(sitk.GetImageFromArray(np.zeros((3, 4), "f4")), str(path))
    with pytest.raises(Refused, match="expected three axes"):
        read_volume(path)
    sitk.WriteImage(sitk.GetImageFromArray(np.zeros((2, 3, 4, 3), "f4"), isVector=True), str(path))
    with pytest.raises(Refused, match="one number per voxel"):
        read_volume(path)
    sitk.WriteImage(sitk.GetImageFromArray(np.zeros((2, 3, 4), "f4")), str(path))
    path.write_bytes(path.read_bytes().replace(b"DimSize = 4 3 2", b"DimSize = 4000 3 2"))
    with pytest.raises(Refused, match="declares 96000 bytes, where a.mha has"):
        read_volume(path)


def test_a_link_to_a_volume_that_was_not_fetched_is_refused(tmp_path):
    """Without it, cases of a folder would be fewer, and split in another way."""
    grid = Grid.centred(4, spacing=2.0)
    for name in "ab":
        save_volume(tmp_path / f"{name}.nii.gz", torch.zeros(grid.shape), grid)
    try:
        (tmp_path / "c.nii.gz").symlink_to("../annex/c")
    except OSError:
        pytest.skip("needs symbolic links")
    with pytest.raises(FileNotFoundError, match=r"c.nii.gz: is a link to .*, which is not there"):
        volumes_in(tmp_path)
    (tmp_path / "c.nii.gz").unlink()
    (tmp_path / "d.nii.gz").symlink_to("a.nii.gz")
    assert [path.name[0] for path in volumes_in(tmp_path)] == ["a", "b", "d"]


def test_a_scene_of_one_file_has_one_case(tmp_path):
    grid = Grid.centred(size=(10, 9, 8), spacing=3.0)
    save_volume(tmp_path / "liver.mha", torch.full(grid.shape, 40.0), grid)
    scene = Volumes(path=str(tmp_path / "liver.mha"))
    assert scene.length == 1 and scene.case(0)[0] == "liver"


PLACED = b"space: left-posterior-superior\nspace directions: (2,0,0) (0,3,0) (0,0,4)\nspace units"


@pytest.mark.parametrize("field", [PLACED, b"spacings: 2 3 4\nunits"])
def test_lengths_of_an_nrrd_are_in_the_unit_of_its_header(field, tmp_path):
    head = b"NRRD0004\ntype: float\ndimension: 3\nsizes: 2 3 4\nendian: little\nencoding: raw\n"
    path, values = tmp_path / "a.nrrd", np.arange(24, dtype="<f4").tobytes()
    for unit, mm in (("mm", 1), ("um", 1e-3), ("cm", 10), ("m", 1e3), ("", 1)):
        units = b": " + b" ".join([f'"{unit}"'.encode()] * 3)
        path.write_bytes(head + field + units + b"\n\n" + values)
        assert read_volume(path)[1].spacing == pytest.approx((2 * mm, 3 * mm, 4 * mm))
    for units in (b'"parsec" "parsec" "parsec"', b'"mm" "mm" "um"'):
        path.write_bytes(head + field + b": " + units + b"\n\n" + values)
        with pytest.raises(Refused, match="expected (one unit of length for all|units of m, cm)"):
            read_volume(path)
