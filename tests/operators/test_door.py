"""Rejected input of projectors, and handling of unusual input."""

import re
from copy import copy

import pytest
import torch

from mvrecon.core.parts import PROJECTORS
from mvrecon.geometry.cameras.camera import VECTORS
from mvrecon.kernels.rays.lines import lines_of
from mvrecon.operators.checks import check_views
from mvrecon.operators.selection import view_subset
from tests.operators.cases import curved
from tests.operators.rigs import CONE, GRID, PARALLEL


@pytest.fixture
def A():
    return PROJECTORS.build("drr", grid=GRID, cameras=CONE)


@pytest.mark.parametrize("shape", [(5, 6, 7), (1, 5, 6, 7), (1, 1, 7, 6, 5)])
def test_a_volume_of_the_wrong_shape_is_refused(A, shape):
    with pytest.raises(
        ValueError, match=rf"volume \[b c d h w\].*\(5, 6, 7\), got {re.escape(str(shape))}"
    ):
        A(torch.zeros(shape))


@pytest.mark.parametrize("shape", [(4, 5, 6), (1, 1, 4, 6, 5), (1, 1, 3, 5, 6)])
def test_views_of_the_wrong_shape_are_refused(A, shape):
    for act in (A.T, lambda views: check_views(views, CONE)):
        with pytest.raises(ValueError, match=rf"views .*\(4, 5, 6\), got {re.escape(str(shape))}"):
            act(torch.zeros(shape))


def test_a_support_of_another_grid_is_refused(A):
    with pytest.raises(ValueError, match=r"\(5, 6, 7\).*got .*\(5, 6, 8\)"):
        A.with_support(torch.ones(5, 6, 8) > 0)


@pytest.mark.parametrize("dtype", [torch.int16, torch.bool, torch.complex64])
def test_lossy_conversions_are_refused(A, dtype):
    for act, shape in (
        (A, GRID.shape),
        (A.T, (4, 5, 6)),
        (view_subset(A, [0, 1, 2, 3]).T, (4, 5, 6)),
    ):
        with pytest.raises(ValueError, match=rf"Expected .*floating point, got {dtype}"):
            act(torch.ones(1, 1, *shape, dtype=dtype))


def test_arrays_are_refused_as_tensors(A):
    with pytest.raises(TypeError, match="a volume .* as a tensor, got ndarray"):
        A(torch.zeros(1, 1, *GRID.shape).numpy())


def test_non_numeric_views_are_refused():
    views = torch.zeros(1, 1, 4, 5, 6)
    check_views(views, CONE)
    views[0, 0, 1, 2, 3] = torch.nan
    with pytest.raises(ValueError, match="1 of 120 values"):
        check_views(views, CONE)


def test_another_device_is_refused(A):
    with pytest.raises(ValueError, match="on cpu, where the projector is, got meta"):
        A(torch.zeros(1, 1, *GRID.shape, device="meta"))


def elsewhere(rays, names: tuple[str, ...]):
    """The same rays without their numbers, as if on another device."""
    moved = copy(rays)
    for name in names:
        object.__setattr__(moved, name, getattr(rays, name).to("meta"))
    return moved


@pytest.mark.parametrize("rig", [CONE, PARALLEL], ids=["cone", "parallel"])
def test_lines_are_on_the_device_of_their_cameras(rig):
    lines = lines_of(elsewhere(rig, VECTORS), GRID)
    assert lines.is_meta and lines.shape == (len(rig), 4, 3, 3)


def test_an_operator_computes_on_the_device_of_its_rays():
    """A grid is a few numbers on the CPU, and ties no operator to it."""
    rays = elsewhere(curved(), ("source", "target"))
    support = torch.ones(GRID.shape, dtype=torch.bool)
    A = PROJECTORS.build("drr", grid=GRID, cameras=rays, support=support, skip="off")
    assert GRID.affine.device.type == "cpu" and A.device.type == "meta" and A.support.is_meta


def test_a_rig_of_the_other_kind_names_the_projector_for_it():
    with pytest.raises(ValueError, match="radon"):
        PROJECTORS.build("drr", grid=GRID, cameras=PARALLEL)
    with pytest.raises(ValueError, match="drr"):
        PROJECTORS.build("radon", grid=GRID, cameras=CONE)


@pytest.mark.parametrize("option", ["method", "backend"])
def test_an_unknown_option_is_refused(option):
    with pytest.raises(ValueError, match=f"Unknown {option} 'fast'. Known"):
        PROJECTORS.build("drr", grid=GRID, cameras=CONE, **{option: "fast"})


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
def test_half_volumes_are_accumulated_in_float32(A, dtype):
    x = torch.rand(1, 1, *GRID.shape).to(dtype).requires_grad_()
    y = A(x)
    y.sum().backward()
    assert y.dtype == torch.float32 and x.grad is not None and x.grad.dtype == dtype
    assert torch.equal(y, A(x.float()))


def test_casting_the_module_leaves_its_geometry_exact(A):
    before = A.lines.clone()
    assert torch.equal(A.half().lines, before) and not A.state_dict()


def test_memory_layout_does_not_matter(A):
    x = torch.rand(2, 3, *GRID.shape)
    y = A(x)
    assert torch.equal(A(x.to(memory_format=torch.channels_last_3d)), y)
    swapped = x.transpose(0, 1).contiguous().transpose(0, 1)
    assert torch.equal(A(swapped), y) and torch.equal(A(x[:, 1:2]), A(x[:, 1:2].contiguous()))
    spread = torch.rand(1, 1, 4, 5, 1).expand(2, 3, 4, 5, 6)
    assert torch.equal(A.T(spread), A.T(spread.contiguous()))


def test_empty_batches_give_empty_views(A):
    assert A(torch.zeros(0, 1, *GRID.shape)).shape == (0, 1, 4, 5, 6)
    assert A.T(torch.zeros(2, 0, 4, 5, 6)).shape == (2, 0, *GRID.shape)


@pytest.mark.parametrize("views", [[0, 2], torch.tensor([0, 2]), slice(2)])
def test_a_subset_by_indices_names_view_subset(A, views):
    with pytest.raises(ValueError, match="view_subset"):
        A.subset(views)
