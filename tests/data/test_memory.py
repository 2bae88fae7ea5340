"""What a large volume takes: the memory of the grid and of some slabs, and not of the volume."""

import gzip
import zlib
from pathlib import Path

import h5py
import nibabel
import numpy as np
import pytest

from mvrecon.core.machine import peak_since, restarted_peak
from mvrecon.core.parts import CAMERAS, SCENES
from mvrecon.data.hdf5 import VolumeFile, write_volumes
from mvrecon.geometry.grid import Grid
from tests.data.conftest import stored
from tests.faults.damage import instead

#: Voxels along z, y, x: 288 MiB as they are stored, 576 in float32.
SHAPE = (576, 512, 512)


def hdf5(folder: Path) -> None:
    """A patient of water, all over the volume, in chunks of 16 planes."""
    write_volumes(folder / "small", stored(1))
    write_volumes(folder / "large", stored(1))
    with h5py.File(folder / "large", "r+") as file:
        packed = {"compression": "gzip", "shuffle": True}
        instead("ct", shape=(1, *SHAPE), dtype="i2", chunks=(1, 16, *SHAPE[1:]), **packed)(file)
        chunk = zlib.compress(bytes(16 * 2 * SHAPE[1] * SHAPE[2]), 1)
        for first in range(0, SHAPE[0], 16):
            file["ct"].id.write_direct_chunk((0, first, 0, 0), chunk)
    assert len(VolumeFile(folder / "large")) == 1


def nifti(folder: Path) -> None:
    """The same; its last axis runs down."""
    affine = np.diag([1.0, 1.0, -1.0, 1.0])
    nibabel.save(nibabel.Nifti1Image(stored(1)[0].ct.T, affine), folder / "small.nii.gz")
    header = nibabel.Nifti1Image(np.zeros((1, 1, 1), "i2"), affine).header
    header.set_data_shape(SHAPE[::-1])
    header["vox_offset"] = 352
    with gzip.open(folder / "large.nii.gz", "wb", compresslevel=1) as file:
        file.write(header.binaryblock[:344] + b"n+1\0" + bytes(4))
        for _ in range(SHAPE[0]):
            file.write(bytes(2 * SHAPE[1] * SHAPE[2]))


@pytest.fixture(
    scope="module",
    params=[(hdf5, "hdf5", ""), (nifti, "volumes", ".nii.gz")],
    ids=["hdf5", "nifti"],
)
def source(request, tmp_path_factory) -> list[str]:
    """The name of a kind of scene, a large file of it and a small one."""
    (make, name, suffix), folder = request.param, tmp_path_factory.mktemp("volumes")
    make(folder)
    return [name, *(str(folder / f"{size}{suffix}") for size in ("large", "small"))]


@pytest.mark.slow
def test_a_large_volume_takes_the_memory_of_slabs(source):
    """A packed volume of 576 MiB in float32 on a small grid takes less than a third of that,
    straight or varied.
    """
    name, large, small = source
    detector = {"pixels": [4, 4], "pixel_mm": 9.0}
    cameras = CAMERAS.build("circular", n_views=1, sid=300.0, sdd=450.0, detector=detector)
    grid, scene = Grid.centred((8, 8, 8), 30.0), SCENES.build(name, path=large, vary=True)
    # what is loaded at first use
    SCENES.build(name, path=small).sample(0, 0, grid, cameras)
    before = restarted_peak()
    for case in (0, 1):
        sample = scene.sample(case, 0, grid, cameras)
        assert (sample.volume > 0.01).sum() > 100, sample.volume.max()
    assert before is None or peak_since(before) < 192 * 2**20
