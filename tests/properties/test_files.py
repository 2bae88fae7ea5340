"""P15: saving, reading and saving again gives the same bytes; and what is written is read back."""

import numpy as np
import pytest
import torch
from hypothesis import given, strategies as st

from mvrecon.core.files.checks import plain_name, yaml_of
from mvrecon.data.hdf5 import Stored, VolumeFile, write_volumes
from mvrecon.data.volume_files import read_volume, save_volume
from mvrecon.geometry.cameras.formats import angles, rtk_xml
from mvrecon.geometry.cameras.rigs import circular
from mvrecon.geometry.grid import Grid
from mvrecon.training import run_folder
from tests.properties.round_trips import FORMATS, placed
from tests.properties.strategies import grids, real, volumes

TEXTS = st.text(st.characters(exclude_categories=["Cs"]), max_size=20)
NUMBERS = st.integers(-(2**70), 2**70) | st.floats(allow_nan=False)
PLAIN = st.none() | st.booleans() | NUMBERS | TEXTS
SETTINGS = st.dictionaries(
    TEXTS,
    st.recursive(
        PLAIN, lambda each: st.lists(each, max_size=3) | st.dictionaries(TEXTS, each, max_size=3)
    ),
)


@pytest.mark.parametrize("name", FORMATS)
@given(data=st.data())
def test_what_is_written_is_read_back(name, data, tmp_path_factory):
    """Volumes on grids off the origin, of unequal spacing, turned, mirrored in pairs of axes or
    sheared, with unit and labels; views with unit, dose and duration; rigs of any kind. A format
    that cannot hold its contents refuses them by name, and no other does; nothing is left behind.

    Tried beside these: voxels of 1e-8 and 1e8 mm, grids far from the origin, float64 beyond
    float32, NaN, one voxel, integers and half precision, see `test_contents_that_are_refused`. The
    formats of mvrecon-spect are in its own tests.
    """
    pytest.importorskip("nibabel")
    pytest.importorskip("SimpleITK")
    FORMATS[name].check(data, tmp_path_factory.mktemp("format"))


def away(millimetres: float, spacing: float = 1.0) -> Grid:
    affine = spacing * torch.eye(4, dtype=torch.float64)
    affine[:, 3] = torch.tensor([millimetres, 0, 0, 1], dtype=torch.float64)
    return Grid((2, 3, 4), affine)


@pytest.mark.parametrize(
    ("ending", "grid", "value", "message"),
    [
        (".nii", away(12345.6789, 1e-3), 1.0, "would move by up to .* of a voxel.*nrrd keep it"),
        (".nii.gz", away(-1e9 / 3), 1.0, "would move by up to"),
        *((ending, away(0, 1e-8), 1.0, "voxels of 1e-06 to") for ending in (".nii", ".mha")),
        *((ending, away(0, 1e8), 1.0, "voxels of 1e-06 to") for ending in (".nii.gz", ".nrrd")),
        *((ending, away(7), 1e300, "greatest of float32") for ending in (".nii", ".mha", ".nrrd")),
    ],
)
def test_contents_that_are_refused(ending, grid, value, message, tmp_path):
    """The readers would refuse them, or find other places or values; formats with double precision
    keep what is far from the origin.
    """
    pytest.importorskip("nibabel")
    pytest.importorskip("SimpleITK")
    x = torch.full(grid.shape, value, dtype=torch.float64)
    with pytest.raises(ValueError, match=message):
        save_volume(tmp_path / f"a{ending}", x, grid)
    assert not list(tmp_path.iterdir())
    if value == 1.0 and grid.spacing[0] in (1.0, 1e-3):
        save_volume(tmp_path / "a.nrrd", x, grid)
        assert torch.equal(read_volume(tmp_path / "a.nrrd")[1].affine, grid.affine)


@pytest.mark.parametrize("axes", [(0,), (1,), (2,), (0, 1, 2)])
@pytest.mark.parametrize("ending", [".nii.gz", ".mha", ".nrrd"])
def test_left_handed_axes_are_refused_in_memory_and_keep_their_places_from_files(
    ending, axes, tmp_path
):
    """Files of other programs may count voxels leftwards, such as NIfTI in LAS."""
    nibabel, sitk = pytest.importorskip("nibabel"), pytest.importorskip("SimpleITK")
    affine = torch.diag(torch.tensor([1.0, 2.0, 3.0, 1.0], dtype=torch.float64))
    affine[:3, 3] = torch.tensor([40.0, -30.0, 7.0])
    for axis in axes:
        affine[axis, axis] *= -1
    x = torch.arange(24.0).reshape(2, 3, 4)
    with pytest.raises(ValueError, match="right-handed.*flip the volume"):
        Grid((2, 3, 4), affine)
    path = tmp_path / f"a{ending}"
    if ending == ".nii.gz":
        nibabel.save(nibabel.Nifti1Image(x.permute(2, 1, 0).numpy(), affine.numpy()), path)
    else:
        image = sitk.GetImageFromArray(x.numpy())
        lps = torch.diag(torch.tensor([-1.0, -1.0, 1.0, 1.0], dtype=torch.float64)) @ affine
        steps = affine[:3, :3].norm(dim=0)
        image.SetSpacing(steps.tolist())
        image.SetOrigin(lps[:3, 3].tolist())
        image.SetDirection((lps[:3, :3] / steps).flatten().tolist())
        sitk.WriteImage(image, str(path))
    y, there = read_volume(path)
    z, j, i = torch.meshgrid(*[torch.arange(n).double() for n in x.shape], indexing="ij")
    world = torch.stack([i, j, z, torch.ones_like(z)], dim=-1) @ affine.T
    place = there.to_index(world[..., :3])
    k, j, i = place.round().long().flip(-1).unbind(dim=-1)
    assert (place - place.round()).abs().max() < 1e-5 and torch.equal(y[k, j, i], x)


@pytest.mark.parametrize("kind", [rtk_xml, angles])
def test_a_small_arc_is_written_in_degrees_that_are_not_taken_for_radians(kind, tmp_path):
    """Eight views within 6 degrees, about 0, negative, and at 0 alone."""
    plate = {"pixels": [4, 5], "pixel_mm": [2.0, 3.0]}
    for first, step in ((0.0, 0.75), (-3.0, 0.75), (-6.0, 0.7), (0.0, 1e-9)):
        rig = circular(8, 400.0, 800.0, plate, angles=[first + step * k for k in range(8)])
        kind.write(rig, tmp_path / "rig")
        found = kind.read(tmp_path / "rig", plate)
        torch.testing.assert_close(found.source, rig.source)
        torch.testing.assert_close(found.origin, rig.origin)


@given(settings=SETTINGS)
def test_settings(settings, tmp_path_factory):
    """Any names, numbers and texts, including those that YAML would interpret differently."""
    one, two = (tmp_path_factory.mktemp(name) for name in ("one", "two"))
    run_folder.start(one, settings)
    found = yaml_of(one / run_folder.SETTINGS)
    assert found == settings
    run_folder.start(two, found)
    assert (one / run_folder.SETTINGS).read_bytes() == (two / run_folder.SETTINGS).read_bytes()


@given(grid=grids(), data=st.data(), mm=st.tuples(*[real(1e-3, 1e3)] * 3))
def test_volumes_of_hdf5(grid, data, mm, tmp_path_factory):
    folder = tmp_path_factory.mktemp("volumes")
    dtype = data.draw(st.sampled_from(["int16", "uint8", "float32", "float64"]))
    values = data.draw(volumes(grid.shape))[0]
    values = (100 * values.clamp(-1, 1)).abs().numpy() if dtype[0] in "iu" else values.numpy()
    with np.errstate(over="ignore"):
        written = [Stored(f"case {k}", each.astype(dtype), mm) for k, each in enumerate(values)]
    write_volumes(folder / "one.h5", written, orientation="LPI")
    file = VolumeFile(folder / "one.h5")
    found = [file.read(k) for k in range(len(file))]
    for one, other in zip(found, written, strict=True):
        assert (one.name, one.spacing) == (
            other.name,
            other.spacing,
        ) and one.ct.dtype == other.ct.dtype
        assert np.array_equal(one.ct, other.ct)
    write_volumes(folder / "two.h5", found, orientation=file.orientation)
    assert (folder / "one.h5").read_bytes() == (folder / "two.h5").read_bytes()


@given(x=placed())
def test_volumes_of_nifti(x, tmp_path_factory):
    """In the reader's order of axes and single precision, the same bytes from the second on."""
    pytest.importorskip("nibabel")
    folder = tmp_path_factory.mktemp("nifti")
    save_volume(folder / "one.nii.gz", *x)
    y, there = read_volume(folder / "one.nii.gz")
    save_volume(folder / "two.nii.gz", y, there)
    z, again = read_volume(folder / "two.nii.gz")
    save_volume(folder / "three.nii.gz", z, again)
    assert torch.equal(z, y) and again.shape == there.shape
    assert (folder / "two.nii.gz").read_bytes() == (folder / "three.nii.gz").read_bytes()


@given(name=TEXTS)
def test_names_of_volumes(name, tmp_path_factory):
    """A name that can be a file's is kept; any other is refused, and nothing is written."""
    folder = tmp_path_factory.mktemp("names")
    volume = Stored(name, np.zeros((1, 1, 1), "int16"), (1.0, 1.0, 1.0))
    try:
        plain_name(name, folder)
    except ValueError:
        with pytest.raises(ValueError):
            write_volumes(folder / "one.h5", [volume])
        assert not list(folder.iterdir())
        return
    write_volumes(folder / "one.h5", [volume])
    assert VolumeFile(folder / "one.h5").read(0).name == name


def test_floats_whose_axes_are_reversed(tmp_path):
    """Shrunk: a NIfTI volume of single precision that does not run to the patient's right, front
    and head.
    """
    pytest.importorskip("nibabel")
    from mvrecon.data.nifti import save_nifti

    x = torch.arange(24.0).reshape(2, 3, 4)
    save_nifti(
        tmp_path / "lps.nii.gz",
        x,
        Grid((2, 3, 4), torch.diag(torch.tensor([-1.0, -1.0, 1.0, 1.0]))),
    )
    y, there = read_volume(tmp_path / "lps.nii.gz")
    assert torch.equal(y, x.flip(1, 2)) and torch.equal(
        there.affine.diagonal(), torch.ones(4).double()
    )
