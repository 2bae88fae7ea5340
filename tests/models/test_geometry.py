"""What a geometry holds: images and rows of each camera, no volume of each."""

from dataclasses import fields, is_dataclass
from typing import Any

import pytest
import torch
from mvrecon.models.crops import cropped_geometry
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

from mvrecon.geometry.box import Box
from mvrecon.models.geometry import whole_geometry
from mvrecon.projectors.ray_transform import RayTransform
from tests.models.rig import small_rig

SIZE, VIEWS = 24, 10


class Largest(TorchDispatchMode):
    """Values in the largest tensor that torch makes within its context."""

    def __init__(self) -> None:
        super().__init__()
        self.values = 0

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        out = func(*args, **(kwargs or {}))
        sizes = [x.numel() for x in tree_leaves(out) if isinstance(x, torch.Tensor)]
        self.values = max([self.values, *sizes])
        return out


def held(part: Any) -> int:
    """Values of all tensors in a dataclass, and in those within it."""
    if isinstance(part, torch.Tensor):
        return part.numel()
    parts = part if isinstance(part, tuple) else ()
    if is_dataclass(part):
        parts = tuple(getattr(part, field.name) for field in fields(part))
    return sum(held(one) for one in parts)


@pytest.mark.parametrize("binning", [None, 2])
def test_neither_the_grid_s_nor_a_crop_s_geometry_is_as_large_as_cameras_times_voxels(binning):
    A = RayTransform(*small_rig(VIEWS, SIZE, SIZE))
    with Largest() as largest:
        whole = whole_geometry(A, binning)
        crop = cropped_geometry(whole, Box((4, 4, 4), (20, 20, 20)))
    assert 0 < largest.values < VIEWS * SIZE**3 / 2
    rows = 0 if binning is None else 5 * VIEWS * SIZE**2  # in both frusta, of bins and voxels
    for geometry in (whole, crop):
        images = VIEWS * SIZE**2 + SIZE**3 + rows
        assert held((geometry.row, geometry.column, geometry.frusta or ())) < 1.5 * images
