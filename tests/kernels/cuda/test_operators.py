"""The kernels of CUDA devices, compiled by g++ and run in main memory, compared with the reference;
the emulated libcuda also runs all of the Python code.
"""

import pytest
import torch

from mvrecon.geometry.grid import Box
from mvrecon.kernels.cuda.launch import Field, Scene
from mvrecon.kernels.rays import reference
from mvrecon.kernels.rays.cuda import operators as cuda
from mvrecon.kernels.rays.occupancy import Occupancy
from mvrecon.kernels.rays.ops import one_by_one
from tests.kernels.cuda.host import Driver, layouts
from tests.kernels.cuda.scenes import CASES, METHODS, RIGS, difference, scene, whole
from tests.kernels.cuda.waits import Waits

#: One volume, and a whole group of four and a part of one.
PRECISIONS = [(torch.float64, 1, 1e-11), (torch.float32, 5, 3e-6)]


def occupied(volume: torch.Tensor) -> torch.Tensor:
    """The packed bounding box of nonzero voxels."""
    rays = torch.zeros(0, 4, 3, 3, dtype=torch.float64), [0.0, 1.0], [1, 1], "joseph"
    return cuda.occupied(volume, *rays, "auto")


@pytest.mark.pairwise(case=CASES, precision=PRECISIONS)
def test_views_volumes_and_pose_gradients_match_the_reference(case, precision, host):
    (kind, method), (dtype, count, bound) = case, precision
    x, y, lines, window, detector = scene(kind, dtype, count)
    shape, moving = list(x.shape[1:]), lines.clone().requires_grad_()
    part = whole(shape)
    views = reference.project(x.double(), moving, window, detector, method)
    volume = reference.backproject(y.double(), lines, window, shape, method)
    assert difference(cuda.project(x, lines, window, detector, method, part), views) < bound
    assert difference(cuda.backproject(y, lines, window, shape, method, part), volume) < bound
    if kind != "axial":  # rays through voxels' centres have two derivatives
        (change,) = torch.autograd.grad((views * y).sum(), moving)
        assert difference(cuda.lines_vjp(x, y, lines, window, method, part), change) < bound


@pytest.mark.parametrize("kind", ["dome", "wide", "dcspect80"])
def test_the_rigs_have_views_of_several_main_axes(kind):
    """What the test above is for: without such views it would say nothing of them."""
    _, _, lines, _, detector = scene(kind)
    rays = one_by_one(lines, detector)[:, 0, :, 0].unflatten(0, (len(lines), -1))
    axes = rays.abs().argmax(dim=2)
    assert (axes != axes[:, :1]).any()


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize(("dtype", "count", "bound"), PRECISIONS)
def test_explicit_rays_match_those_of_the_camera(method, dtype, count, bound, host):
    x, y, lines, window, detector = scene("dome", dtype, count)
    single, shape, part = one_by_one(lines, detector), list(x.shape[1:]), whole(x.shape[1:])
    z = y.flatten(1)[..., None, None]
    views = reference.project(x.double(), lines, window, detector, method)
    one = cuda.project(x, single, window, [1, 1], method, part)
    assert difference(one.flatten(1), views.flatten(1)) < bound
    volume = reference.backproject(y.double(), lines, window, list(x.shape[1:]), method)
    assert difference(cuda.backproject(z, single, window, shape, method, part), volume) < bound
    moving = single.clone().requires_grad_()
    again = reference.project(x.double(), moving, window, [1, 1], method)
    (change,) = torch.autograd.grad((again * z).sum(), moving)
    assert difference(cuda.lines_vjp(x, z, single, window, method, part), change) < bound


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("kind", ["dome", "parallel"])
def test_a_part_of_a_volume_is_read_and_written_separately(kind, method, host):
    """For a volume that is zero outside a box, passing only the box, or the volume with the box on
    the device, gives the same bits.
    """
    x, y, lines, window, detector = scene(kind, torch.float32)
    box, all_ = Box((1, 0, 2), (4, 3, 5)), whole(x.shape[1:])
    part, inside = Occupancy(all_.shape, box), torch.zeros_like(x)
    inside[:, *box.slices] = x[:, *box.slices]
    code = occupied(inside)
    rays = lines, window
    views = cuda.project(inside, *rays, detector, method, all_)
    assert torch.equal(cuda.project(inside, *rays, detector, method, all_, code), views)
    cut = inside[:, *box.slices]
    assert torch.equal(cuda.project(cut, *rays, detector, method, part), views)
    volume = cuda.backproject(y, *rays, all_.box.shape, method, all_)[:, *box.slices]
    assert torch.equal(cuda.backproject(y, *rays, part.box.shape, method, part), volume)
    change = cuda.lines_vjp(inside, y, *rays, method, all_)
    for few in (
        cuda.lines_vjp(inside, y, *rays, method, all_, code),
        cuda.lines_vjp(cut, y, *rays, method, part),
    ):
        assert difference(few, change) < 1e-6


def test_the_box_of_nonzero_voxels_matches_the_reference(host):
    x = torch.zeros(2, 5, 6, 7)
    x[0, 2, 1, 3], x[1, 3, 4, 6], x[1, 3, 5, 5] = 1e-30, float("nan"), -1
    found = Occupancy.decoded(occupied(x))
    assert found.box == Box.around(x != 0) and found.shape == (5, 6, 7) and found.bricks is None
    nothing = Occupancy.decoded(occupied(torch.zeros(1, 5, 6, 7)))
    assert nothing.box.size == 0
    _, _, lines, window, detector = scene("cone")
    empty = torch.zeros(1, *RIGS["cone"][0].shape)
    code = occupied(empty)
    assert not cuda.project(
        empty, lines, window, detector, "joseph", whole(empty.shape[1:]), code
    ).any()


@pytest.mark.parametrize(("dtype", "count"), [(torch.float16, 1), (torch.bfloat16, 5)])
@pytest.mark.parametrize("method", METHODS)
def test_half_precision_volumes_are_read_without_conversion(method, dtype, count, host):
    """Not by way of a copy in float32: to the bits of one."""
    x, y, lines, window, detector = scene("dome", torch.float32, count)
    half, part = x.to(dtype), whole(x.shape[1:])
    views = cuda.project(half, lines, window, detector, method, part)
    assert views.dtype == torch.float32
    assert torch.equal(views, cuda.project(half.float(), lines, window, detector, method, part))
    change = cuda.lines_vjp(half, y, lines, window, method, part)
    assert torch.equal(change, cuda.lines_vjp(half.float(), y, lines, window, method, part))


@pytest.mark.parametrize("method", METHODS)
def test_views_in_pieces_give_the_same_volume(method, host, monkeypatch):
    _, y, lines, window, _ = scene("dcspect80", torch.float32, 5)
    shape = RIGS["dcspect80"][0].shape
    part = whole(shape)
    volume = cuda.backproject(y, lines, window, shape, method, part)
    host.launches.clear()
    monkeypatch.setattr(cuda, "SHARE", 0.0)
    assert difference(cuda.backproject(y, lines, window, shape, method, part), volume) < 1e-6
    assert host.launches == ["survey", *["record", "gather"] * len(lines)]


def test_an_operator_launches_few_kernels_on_the_current_stream_without_synchronisation(host):
    x, y, lines, window, detector = scene("cone", torch.float32)
    part = whole(x.shape[1:])
    with Waits() as waits:
        code = occupied(x)
        cuda.project(x, lines, window, detector, "joseph", part, code)
        cuda.backproject(y, lines, window, part.box.shape, "joseph", part)
        cuda.lines_vjp(x, y, lines, window, "joseph", part, code)
    assert waits.names == []
    assert host.launches == [
        *("occupy", "bound"),
        *("survey", "store", "project"),
        *("survey", "record", "gather"),
        *("survey", "store", "vary"),
    ]
    assert set(host.streams) == {7} and host.modules == 1


@pytest.mark.parametrize("packed", [Scene, Field])
def test_the_packed_structure_matches_the_source(packed, libraries):
    ours, theirs = layouts(packed, libraries[packed])
    assert ours == theirs


def test_empty_rays_and_volumes_launch_no_kernel(host):
    x, y, lines, window, detector = scene("cone", torch.float32)
    part = whole(x.shape[1:])
    assert cuda.project(x, lines[:0], window, detector, "joseph", part).shape == (1, 0, *detector)
    assert not cuda.backproject(y[:, :0], lines[:0], window, part.box.shape, "joseph", part).any()
    assert cuda.lines_vjp(x, y[:, :0], lines[:0], window, "joseph", part).shape == (0, 4, 3, 3)
    nothing = Occupancy(part.shape, Box((0, 0, 0), (0, 0, 0)))
    views = cuda.project(x[:, :0, :0, :0], lines, window, detector, "siddon", nothing)
    assert not views.any()


def test_a_thread_without_a_context_uses_that_of_its_device(host, monkeypatch):
    x, _, lines, window, detector = scene("cone", torch.float32)
    right, codes, entered = Driver.cuLaunchKernel, [201], []

    def launch(driver, *arguments):
        return codes.pop() if codes else right(driver, *arguments)

    monkeypatch.setattr(Driver, "cuLaunchKernel", launch)
    monkeypatch.setattr(
        Driver, "cuCtxSetCurrent", lambda *_: entered.append(1) and 0 or 0, raising=False
    )
    views = cuda.project(x, lines, window, detector, "joseph", whole(x.shape[1:]))
    assert views.any() and len(entered) == 2  # at loading, and after the refusal
