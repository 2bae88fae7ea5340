"""Small files: a ball of water with a bone in it, in air."""

import numpy as np
import pytest
import torch

from mvrecon.data.hdf5 import Stored, write_volumes
from mvrecon.geometry.grid import Grid, voxel_centres

SPACING = (3.0, 2.0, 2.0)  # z, y, x
RIG = {
    "name": "circular",
    "n_views": 3,
    "sid": 300.0,
    "sdd": 450.0,
    "detector": {"pixels": [10, 12], "pixel_mm": 9.0},
}


def head(centre=(0.0, 0.0, 0.0), radius=16.0, shape=(20, 30, 30)):
    """HU of a ball of water in air, with a ball of bone off its centre towards (+x, -y, +z)."""
    xyz = voxel_centres(Grid.centred(size=shape[::-1], spacing=SPACING[::-1]))
    ball = (xyz - torch.tensor(centre, dtype=xyz.dtype)).norm(dim=-1)
    bone = (xyz - torch.tensor(centre, dtype=xyz.dtype) - torch.tensor([6.0, -4.0, 3.0])).norm(
        dim=-1
    )
    hu = torch.where(bone < 5, 1000.0, torch.where(ball < radius, 0.0, -1000.0))
    return hu.numpy().astype(np.int16)


def stored(count, **options):
    return [Stored(f"pt_{k}", head((k, 0, 0), **options), SPACING) for k in range(count)]


@pytest.fixture
def grid():
    return Grid.centred((8, 8, 8), 6.0)


@pytest.fixture
def volume_file(tmp_path):
    """Seven heads, each 1 mm further along x."""
    path = tmp_path / "heads.h5"
    write_volumes(path, stored(7))
    return path
