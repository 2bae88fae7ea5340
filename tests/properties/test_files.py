"""P15: saving, reading and saving again gives the same bytes."""

import numpy as np
import pytest
import torch
from hypothesis import given, strategies as st

from mvrecon.core.files.checks import plain_name
from mvrecon.data.hdf5 import Stored, VolumeFile, write_volumes
from mvrecon.geometry.grid import Grid
from mvrecon.training import run_folder
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


@given(settings=SETTINGS)
def test_settings(settings, tmp_path_factory):
    """Any names, numbers and texts, including those that YAML would interpret differently."""
    one, two = (tmp_path_factory.mktemp(name) for name in ("one", "two"))
    run_folder.start(one, settings)
    found = run_folder.read_settings(one)
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


@given(grid=grids(), data=st.data())
def test_volumes_of_nifti(grid, data, tmp_path_factory):
    """Voxels keep their positions, for any axis order of the reader."""
    pytest.importorskip("nibabel")
    from mvrecon.data.nifti import save_nifti
    from mvrecon.data.volume_files import read_volume

    folder = tmp_path_factory.mktemp("nifti")
    x = data.draw(volumes(grid.shape, torch.float32))[0, 0]
    save_nifti(folder / "one.nii.gz", x, grid)
    y, there = read_volume(folder / "one.nii.gz")
    size = 8 * torch.finfo(torch.float32).eps * grid.corners().abs().max()
    assert torch.equal(y.flatten().sort().values, x.flatten().sort().values)
    corners = torch.cdist(there.corners(), grid.corners())
    assert (corners.amin(dim=0) <= size).all() and (corners.amin(dim=1) <= size).all()
    place = there.to_index(
        grid.to_world(torch.cartesian_prod(*[torch.arange(n).double() for n in grid.shape[::-1]]))
    )
    k, j, i = place.round().long().flip(-1).unbind(dim=-1)
    assert torch.equal(y[k, j, i].reshape(grid.shape[::-1]), x.permute(2, 1, 0))
    # its affine is single precision by now, and its axes are in order: the same bytes from here on
    save_nifti(folder / "two.nii.gz", y, there)
    z, again = read_volume(folder / "two.nii.gz")
    save_nifti(folder / "three.nii.gz", z, again)
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
    from mvrecon.data.volume_files import read_volume

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
