"""Quantities that are kept beside an operator, and SIRT's weights in it."""

import gc
import weakref
from dataclasses import fields, is_dataclass
from typing import Any

import pytest
import torch
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

from mvrecon.core.parts import PROJECTORS
from mvrecon.methods.learned.geometry import Geometry, geometry_of, kept
from mvrecon.methods.learned.view_frames import ViewFrames
from mvrecon.operators.operator import Scaled
from mvrecon.operators.ray_transform import RayTransform
from tests.methods.learned.rig import blob, small, small_projector, small_rig, stirred

SIZE, VIEWS = 24, 10


def counted(A):
    """How often `kept` computes a result of an operator."""
    calls = []
    return calls, lambda: kept(A, "count", lambda: calls.append(1) or len(calls))


def test_a_result_is_computed_once_for_each_operator_and_key():
    A, B = small_projector(), small_projector()
    calls, look = counted(A)
    assert look() == look() == 1
    assert kept(B, "count", lambda: "other") == "other" and kept(A, "key", lambda: 5) == 5
    assert look() == 1 and len(calls) == 1


def test_it_is_recomputed_after_a_tensor_of_the_operator_was_modified():
    grid, cameras = small_rig()
    A = Scaled(
        PROJECTORS.build("drr", grid=grid, cameras=cameras), pixels=torch.full((4, 12, 12), 3.0)
    )
    views = A(blob(A))
    _, look = counted(A)
    method = stirred("cross_view")
    before = method(views, A).volume
    assert look() == 1
    A.fixed_factors.mul_(2.0)
    assert look() == 2 == look()
    # twice the weight of every pixel and twice the views: the same volume
    torch.testing.assert_close(method(2 * views, A).volume, before)
    A.cameras.source.add_(1.0)
    assert look() == 3


def test_nothing_is_cached_for_cameras_with_a_gradient():
    A = small_projector()
    _, look = counted(A)
    assert look() == look() == 1
    A.cameras.source.requires_grad_()
    assert look() == 2 and look() == 3


def test_a_cached_result_does_not_keep_its_operator_alive():
    A, method = small_projector(), small("cross_view", support="none")
    method(A(blob(A)), A)
    gone = weakref.ref(A)
    del A
    gc.collect()
    assert gone() is None


def test_a_result_cached_in_evaluation_is_used_in_training():
    A, method = small_projector(), stirred("cross_view")
    views = A(blob(A))
    with torch.inference_mode():
        expected = method.eval()(views, A).volume
    volume = method.train()(views, A).volume
    volume.sum().backward()
    assert torch.equal(volume, expected)


@pytest.mark.filterwarnings("ignore:Rays are up to")
@pytest.mark.parametrize("support", ["none", "hull"])
@torch.no_grad()
def test_no_ray_is_weighted_by_less_than_a_tenth_of_the_longest_chord(support):
    """Else the readings of an overexposed view where rays graze the region would be all of a
    residual.
    """
    A = small_projector()
    g = geometry_of(A(blob(A, 2)), A, support)
    region = torch.ones(1, 1, 12, 12, 12) if g.support is None else g.support.float()
    chords = A(region)
    longest = chords.amax(dim=(1, 2, 3, 4), keepdim=True)
    expected = torch.where(chords > 0, 1 / chords.maximum(0.1 * longest), 0.0)
    assert ((chords > 0) & (chords < 0.1 * longest)).any()
    torch.testing.assert_close(g.row.expand_as(expected), expected, rtol=1e-5, atol=0)
    torch.testing.assert_close(g.sums.expand_as(chords), chords, rtol=1e-4, atol=1e-4)


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


@torch.no_grad()
def test_frames_store_images_and_rows_but_no_volume_per_camera():
    A = RayTransform(*small_rig(VIEWS, SIZE, SIZE))
    with Largest() as largest:
        g = Geometry.of(A)
        frames = ViewFrames.of(g, 0, 1, SIZE)
    assert 0 < largest.values < VIEWS * SIZE**3 / 2
    images, rows = 2 * VIEWS * SIZE**2 + SIZE**3, 4 * VIEWS * SIZE**2  # ends of bins and voxels
    assert held((g.row, g.column, g.sums, frames)) < 1.5 * (images + rows)


@torch.no_grad()
def test_no_operation_at_a_coarser_scale_allocates_a_volume_per_camera():
    """Of the grid's resolution; features in cells of 2^3 voxels have few channels."""
    A, method = small_projector(n_views=16, size=16), stirred("cross_view", widths=[2, 4])
    views = A(blob(A))
    method(views, A)  # keeps what is kept
    with Largest() as largest:
        out = method(views, A)
    assert out.per_view.shape == (1, 16, 1, 8, 8, 8)
    assert largest.values < 16 * 16**3
