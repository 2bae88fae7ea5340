"""NIfTI: an object has the same position for any storage order of its voxels."""

import gzip
import sys
from random import Random

import nibabel
import numpy as np
import pytest
import torch

from mvrecon.data import resample as slabs
from mvrecon.data.resample import resample
from mvrecon.data.volume_files import read_volume
from mvrecon.data.volumes import Volumes
from mvrecon.geometry.grid import Grid, voxel_centres
from mvrecon.geometry.rigid import euler_rotation

SIZE = 40


def blobs(xyz):
    """An asymmetric smooth object: four Gaussian balls, none the mirror image of another."""
    places = torch.tensor([[0, 0, 0], [12, 0, 0], [0, 9, 0], [3, 0, -8]], dtype=torch.float64)
    return (
        torch.tensor([1.0, 0.8, 0.6, 0.4])
        * torch.exp(-((xyz[..., None, :] - places) ** 2).sum(-1) / (2 * 4.0**2))
    ).sum(-1)


def save(path, affine, scale=1.0, units="mm"):
    """Store the object sampled at the voxels of an affine (index i, j, k to world mm)."""
    i, j, k = np.meshgrid(*[np.arange(SIZE)] * 3, indexing="ij")
    xyz = np.stack([i, j, k, np.ones_like(i)], axis=-1) @ affine.T
    values = blobs(torch.from_numpy(xyz[..., :3])).numpy()
    stored = affine.copy()
    stored[:3] /= {"mm": 1, "meter": 1000}[units]
    image = nibabel.Nifti1Image(
        np.rint((values - 0.25) / scale).astype(np.int16) if scale != 1 else values, stored
    )
    image.header.set_xyzt_units(units)
    if scale != 1:
        image.header.set_slope_inter(scale, 0.25)
    nibabel.save(image, path)


def centred(linear, target=(1.0, 2.0, -3.0)):
    affine = np.eye(4)
    affine[:3, :3] = linear
    affine[:3, 3] = np.array(target) - affine[:3, :3] @ np.full(3, (SIZE - 1) / 2)
    return affine


AFFINES = {
    "ras": np.diag([1.5, 1.5, 1.5]),
    "las": np.diag([-1.5, 1.5, 1.5]),
    "lps": np.diag([-1.5, -1.5, 1.5]),
    "permuted": np.array([[0, 0, 1.5], [-1.5, 0, 0], [0, 1.5, 0]]),
    "anisotropic": np.diag([1.2, -1.6, 1.4]),
    "oblique": euler_rotation([20.0, -15.0, 10.0], "xyz").numpy() * 1.5,
    "oblique and mirrored": euler_rotation([10.0, 25.0, -30.0], "xyz").numpy()
    @ np.diag([-1.5, 1.5, 1.5]),
}


@pytest.mark.parametrize("name", AFFINES)
def test_an_object_has_its_world_position(tmp_path, name):
    path = tmp_path / "a.nii.gz"
    save(path, centred(AFFINES[name]))
    values, grid = read_volume(path)
    assert torch.allclose(values.double(), blobs(voxel_centres(grid)), atol=1e-6)
    target = Grid.centred(size=(12, 11, 8), spacing=3.0, centre=(2.0, 1.0, -1.0))
    expected = (
        blobs(voxel_centres(target.refined(4))).reshape(8, 4, 11, 4, 12, 4).mean(dim=(1, 3, 5))
    )
    assert torch.allclose(resample(values, grid, target).double(), expected, atol=0.03)


@pytest.mark.parametrize(("scale", "units"), [(1e-4, "mm"), (1.0, "meter")])
def test_slope_intercept_and_units_are_respected(tmp_path, scale, units):
    path = tmp_path / "a.nii"
    save(path, centred(AFFINES["las"]), scale, units)
    values, grid = read_volume(path)
    assert grid.spacing == pytest.approx((1.5, 1.5, 1.5), rel=1e-5)
    assert torch.allclose(values.double(), blobs(voxel_centres(grid)), atol=1e-3)


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"no\.nii: no such file; expected a NIfTI volume"):
        read_volume(tmp_path / "no.nii")


@pytest.mark.parametrize("suffix", [".nii", ".nii.gz"])
def test_a_truncated_file_is_an_error(tmp_path, suffix):
    path = tmp_path / f"a{suffix}"
    save(path, centred(AFFINES["ras"]))
    path.write_bytes(path.read_bytes()[:20_000])
    with pytest.raises(ValueError, match=r"(?s)a\.nii.*cannot be read .*cut short\?"):
        read_volume(path)


def test_foreign_files_are_refused(tmp_path):
    text = tmp_path / "a.nii"
    text.write_text("hello")
    with pytest.raises(ValueError, match=r"a\.nii: cannot be read"):
        read_volume(text)
    four = tmp_path / "four.nii"
    nibabel.save(nibabel.Nifti1Image(np.zeros((3, 3, 3, 2)), np.eye(4)), four)
    with pytest.raises(ValueError, match=r"shape \(3, 3, 3, 2\); expected .* three axes"):
        read_volume(four)
    flat = tmp_path / "flat.nii"
    image = nibabel.Nifti1Image(np.zeros((3, 3, 3)), np.eye(4))
    image.header.set_sform(np.diag([1.0, 1, 0, 1]), code=1)
    nibabel.save(nibabel.Nifti1Image(image.dataobj, None, image.header), flat)
    with pytest.raises(ValueError, match="expected a finite one that can be inverted"):
        read_volume(flat)


def test_without_nibabel_the_extra_is_named(tmp_path, monkeypatch):
    save(tmp_path / "a.nii", centred(AFFINES["ras"]))
    monkeypatch.setitem(sys.modules, "nibabel", None)
    with pytest.raises(ImportError, match=r"pip install 'mvrecon\[io\]'"):
        read_volume(tmp_path / "a.nii")


def test_compressed_values_are_read_as_written_or_not_at_all(tmp_path):
    """A `.nii.gz` in which one bit has flipped, anywhere, is refused or has the values that were
    written.
    """
    path = tmp_path / "a.nii.gz"
    save(path, centred(AFFINES["las"]), 1e-3)
    whole, (values, grid), rng, refused = path.read_bytes(), read_volume(path), Random(1), 0
    for _ in range(200):
        damaged = bytearray(whole)
        damaged[rng.randrange(len(whole))] ^= 1 << rng.randrange(8)
        path.write_bytes(damaged)
        try:
            again, there = read_volume(path)
        except ValueError as error:
            refused += "a.nii.gz" in str(error)
            continue
        assert torch.equal(again, values) and torch.equal(there.affine, grid.affine)
    assert refused > 190


@pytest.mark.parametrize("name", ["a.NII", "a.nii.GZ", "a.Nii.gz", "a.b.nii"])
def test_file_extensions_are_case_insensitive(tmp_path, name):
    """`.NII`, `.NII.GZ` and the like are read as `.nii` and `.nii.gz` are."""
    save(tmp_path / "plain.nii", centred(AFFINES["ras"]))
    raw = (tmp_path / "plain.nii").read_bytes()
    (tmp_path / name).write_bytes(gzip.compress(raw) if name.lower().endswith("gz") else raw)
    assert torch.equal(read_volume(tmp_path / name)[0], read_volume(tmp_path / "plain.nii")[0])
    assert Volumes(path=str(tmp_path / name)).case(0)[0] == name[: name.lower().index(".nii")]


@pytest.mark.parametrize("more", [(1,), (1, 1)])
def test_singleton_axes_after_the_third_are_dropped(tmp_path, more):
    """A NIfTI of four or five axes with one volume is read as that volume."""
    values = np.arange(24, dtype=np.int16).reshape(2, 3, 4)
    for name, array in (("three.nii", values), ("more.nii", values.reshape(*values.shape, *more))):
        nibabel.save(nibabel.Nifti1Image(array, np.diag([-2.0, 2.0, 3.0, 1.0])), tmp_path / name)
    (three, grid), (four, there) = (
        read_volume(tmp_path / "three.nii"),
        read_volume(tmp_path / "more.nii"),
    )
    assert (
        torch.equal(three, four)
        and torch.equal(grid.affine, there.affine)
        and four.shape == (4, 3, 2)
    )


@pytest.mark.parametrize("name", AFFINES)
def test_slabs_equal_the_values_of_nibabel(tmp_path, name, monkeypatch):
    path = tmp_path / "a.nii.gz"
    save(path, centred(AFFINES[name]), 1e-3)
    canonical = nibabel.as_closest_canonical(nibabel.load(path))
    monkeypatch.setattr(slabs, "SLAB_VOXELS", 7 * SIZE**2)
    values, grid = read_volume(path)
    assert np.array_equal(values.numpy(), canonical.get_fdata(dtype="float32").T)
    assert np.array_equal(grid.affine.numpy(), canonical.affine)


def test_excess_data_after_a_compressed_volume_is_refused(tmp_path):
    path = tmp_path / "a.nii.gz"
    save(tmp_path / "a.nii", centred(AFFINES["ras"]))
    path.write_bytes(gzip.compress((tmp_path / "a.nii").read_bytes() + bytes(2**25)))
    with pytest.raises(ValueError, match=r"a\.nii\.gz: has over \d+ bytes behind the volume"):
        read_volume(path)
