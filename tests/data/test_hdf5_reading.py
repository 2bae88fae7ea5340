"""Opening of HDF5 files for reading."""

import struct
from pathlib import Path

import h5py
import numpy as np
import pytest

from mvrecon.core.files.checks import Refused
from mvrecon.data.hdf5 import VolumeFile
from mvrecon.data.projections.opening import open_projections
from mvrecon_baselines.pytorch3dunet import read_example

READERS = {
    "views.h5": open_projections,
    "volumes.h5": lambda path: VolumeFile(path).file,
    "example.h5": read_example,
}


@pytest.mark.parametrize("name", READERS)
def test_a_cycle_in_the_name_heap_is_refused(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    """An HDF5 file whose list of free blocks is a circle is refused before libhdf5 follows it."""
    path = tmp_path / name
    with h5py.File(path, "w") as file:
        file["views"] = np.ones((2, 3, 4), "f4")
    whole = path.read_bytes()
    offset, data = struct.unpack_from("<QQ", whole, whole.index(b"HEAP") + 16)
    damaged = bytearray(whole)
    struct.pack_into("<Q", damaged, data + offset, offset)
    path.write_bytes(damaged)

    def never(*_: object, **__: object):
        raise AssertionError("libhdf5 would take all memory")

    monkeypatch.setattr(h5py, "File", never)
    with pytest.raises(Refused, match=f"{name}: .*got a circle"):
        READERS[name](path)
