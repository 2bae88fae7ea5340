"""Values derived from a rig, computed once per device."""

import gc
import weakref
from dataclasses import replace

import pytest
import torch

from mvrecon.geometry.grid import Grid
from mvrecon.kernels import device_cache as module
from mvrecon.kernels.device_cache import device_cached, grid_key
from tests.operators.rigs import CONE


@pytest.fixture
def rig():
    return replace(CONE, source=CONE.source.clone())


def counted(rig, key=(), like=None):
    """Number of computations in three calls."""
    made = []
    for _ in range(3):
        device_cached(rig, key, torch.zeros(1) if like is None else like, lambda: made.append(1))
    return len(made)


def test_a_value_is_computed_once_per_key_and_device(rig):
    assert counted(rig) == 1 and counted(rig) == 0
    assert counted(rig, "another") == 1
    assert counted(rig, like=torch.zeros(1, device="meta")) == 1


def test_modified_cameras_are_recomputed_and_trainable_ones_are_never_cached(rig):
    assert counted(rig) == 1
    rig.source.mul_(1.1)
    assert counted(rig) == 1
    rig.source.requires_grad_()
    assert counted(rig) == 3


def test_values_cached_in_evaluation_support_derivatives_in_training(rig):
    with torch.inference_mode():
        device_cached(rig, "ones", torch.zeros(1), lambda: torch.ones(3))
    kept = device_cached(rig, "ones", torch.zeros(1), lambda: None)
    x = torch.ones(3, requires_grad=True)
    assert (x * kept).sum().backward() is None and x.grad is not None


def test_the_cache_is_released_with_its_rig(rig):
    other, result = rig[[0]], torch.ones(1)
    device_cached(other, (), torch.zeros(1), lambda: result)
    gone, count = weakref.ref(other), len(module._results)
    del other
    gc.collect()
    assert gone() is None and len(module._results) < count


def test_grids_are_distinguished_by_the_positions_of_their_voxels():
    grids = [Grid.centred(4, spacing=s, centre=(c, 0, 0)) for s in (1.0, 2.0) for c in (0.0, 1.0)]
    assert len({grid_key(grid) for grid in grids}) == 4
    assert grid_key(Grid.centred(4, spacing=1.0)) == grid_key(grids[0])
