"""The kernels of the CUDA back end against the reference: on a device where there is one, else in
numba's simulator, see `test_simulator.py`.
"""

import pytest
import torch

from mvrecon.geometry.box import Box
from mvrecon.kernels.rays import reference
from mvrecon.kernels.rays.lines import lines_of
from mvrecon.kernels.rays.occupancy import Occupancy
from tests.kernels.cuda.scenes import (
    CASES,
    DEVICE,
    METHODS,
    RIGS,
    close,
    kernels,
    rays_as_views,
    scene,
    whole,
)


@kernels
@pytest.mark.parametrize(("kind", "method"), CASES)
def test_project(kind, method):
    from mvrecon.kernels.rays.cuda import operators as cuda

    x, _, lines, window, detector = scene(kind)
    expected = reference.project(x, lines, window, detector, method)
    assert close(cuda.project(x, lines, window, whole(x.shape[1:]), detector, method), expected)


@kernels
@pytest.mark.parametrize(("kind", "method"), CASES)
def test_backproject(kind, method):
    from mvrecon.kernels.rays.cuda import operators as cuda

    x, y, lines, window, _ = scene(kind)
    shape = list(x.shape[1:])
    expected = reference.backproject(y, lines, window, shape, method)
    assert close(cuda.scatter(y, lines, window, whole(shape), method), expected)
    assert close(cuda.backproject(y, lines, window, whole(shape), method), expected)


@kernels
@pytest.mark.parametrize(
    ("kind", "method"), [(kind, method) for kind, method in CASES if kind in ("dome", "parallel")]
)
def test_a_part_of_a_volume(kind, method):
    """The occupied box of a volume is read and written as if the rest of it were zero, or left
    out.
    """
    from mvrecon.kernels.rays.cuda import operators as cuda

    x, y, lines, window, detector = scene(kind)
    box = Box((1, 0, 2), (4, 2, 5))
    occupancy, inside = Occupancy(whole(x.shape[1:]).shape, box), torch.zeros_like(x)
    inside[:, *box.slices] = 1
    part = x[:, *box.slices]
    moving = lines.clone().requires_grad_()
    views = reference.project(x * inside, moving, window, detector, method)
    assert close(cuda.project(part, lines, window, occupancy, detector, method), views.detach())
    expected = reference.backproject(y, lines, window, list(x.shape[1:]), method)[:, *box.slices]
    assert close(cuda.scatter(y, lines, window, occupancy, method), expected)
    assert close(cuda.backproject(y, lines, window, occupancy, method), expected)
    (change,) = torch.autograd.grad((views * y).sum(), moving)
    assert close(cuda.lines_vjp(part, y, lines, window, occupancy, method), change, 1e-9)


@kernels
@pytest.mark.parametrize("kind", ["dome", "parallel"])
def test_gather_in_pieces(kind, monkeypatch):
    from mvrecon.kernels.rays.cuda import operators as cuda

    x, y, lines, window, _ = scene(kind)
    shape = list(x.shape[1:])
    monkeypatch.setattr(cuda, "RAYS", 1)
    assert close(
        cuda.gather(y, lines, window, whole(shape), "joseph"),
        cuda.scatter(y, lines, window, whole(shape), "joseph"),
    )


@kernels
@pytest.mark.parametrize(("kind", "method"), CASES)
def test_lines_vjp(kind, method, monkeypatch):
    from mvrecon.kernels.rays.cuda import operators as cuda

    x, y, lines, window, detector = scene(kind)
    monkeypatch.setattr(cuda, "THREADS", 16)  # several pixels a thread
    moving = lines.clone().requires_grad_()
    (expected,) = torch.autograd.grad(
        (reference.project(x, moving, window, detector, method) * y).sum(), moving
    )
    assert close(cuda.lines_vjp(x, y, lines, window, whole(x.shape[1:]), method), expected, 1e-9)


@kernels
@pytest.mark.parametrize("method", METHODS)
def test_several_volumes_share_their_rays(method):
    """Six volumes are a whole group and a part of one."""
    from mvrecon.kernels.rays.cuda import operators as cuda

    x, y, lines, window, detector = scene("dome", count=6)
    shape = list(x.shape[1:])
    assert close(
        cuda.project(x, lines, window, whole(x.shape[1:]), detector, method),
        reference.project(x, lines, window, detector, method),
    )
    expected = reference.backproject(y, lines, window, shape, method)
    assert close(cuda.backproject(y, lines, window, whole(shape), method), expected)
    assert close(cuda.scatter(y, lines, window, whole(shape), method), expected)
    apart = sum(
        cuda.lines_vjp(x[i : i + 1], y[i : i + 1], lines, window, whole(x.shape[1:]), method)
        for i in range(6)
    )
    assert close(cuda.lines_vjp(x, y, lines, window, whole(x.shape[1:]), method), apart)


@kernels
@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float16])
def test_single_precision_stays_single(dtype, method):
    from mvrecon.kernels.rays.cuda import operators as cuda

    x, y, lines, window, detector = scene("dome", dtype)
    shape = list(x.shape[1:])
    exact = reference.project(x.double(), lines, window, detector, method)
    views = cuda.project(x, lines, window, whole(x.shape[1:]), detector, method)
    assert views.dtype == torch.float32 and close(views.double(), exact, 3e-6)
    exact = reference.backproject(y.double(), lines, window, shape, method)
    volume = cuda.backproject(y, lines, window, whole(shape), method)
    assert volume.dtype == torch.float32 and close(volume.double(), exact, 3e-6)


@kernels
@pytest.mark.parametrize("method", METHODS)
def test_tiles_cover_the_detector(method):
    """A detector larger than a tile, and no multiple of one."""
    from mvrecon.kernels.rays.cuda import operators as cuda

    x, _, lines, window, _ = scene("dome")
    detector = [9, 17]
    expected = reference.project(x, lines, window, detector, method)
    assert close(cuda.project(x, lines, window, whole(x.shape[1:]), detector, method), expected)


@kernels
@pytest.mark.parametrize("method", METHODS)
def test_wide_indices_change_nothing(method, monkeypatch):
    """Volumes beyond 2^32 voxels are counted in 64 bits."""
    from mvrecon.kernels.rays.cuda import operators as cuda

    x, y, lines, window, detector = scene("dome")
    shape = list(x.shape[1:])
    short = (
        cuda.project(x, lines, window, whole(x.shape[1:]), detector, method),
        cuda.scatter(y, lines, window, whole(shape), method),
    )
    monkeypatch.setattr(cuda, "WIDE", 1)
    long = (
        cuda.project(x, lines, window, whole(x.shape[1:]), detector, method),
        cuda.scatter(y, lines, window, whole(shape), method),
    )
    assert torch.equal(short[0], long[0]) and close(long[1], short[1], 1e-14)


@kernels
@pytest.mark.parametrize("method", METHODS)
def test_rays_given_one_by_one(method):
    from mvrecon.kernels.rays.cuda import operators as cuda

    grid, cameras = RIGS["dome"]
    x, *_ = scene("dome")
    lines = rays_as_views(grid, cameras)
    y = torch.randn(1, len(lines), 1, 1, dtype=torch.float64, device=DEVICE)
    window, shape = list(cameras.ray_extent), list(x.shape[1:])
    views = cuda.project(x, lines, window, whole(x.shape[1:]), [1, 1], method)
    expected = reference.project(
        x, lines_of(cameras, grid).to(DEVICE), window, list(cameras.shape), method
    )
    assert close(views.flatten(), expected.flatten())
    volume = cuda.backproject(y, lines, window, whole(shape), method)
    assert torch.isclose((views * y).sum(), (x * volume).sum(), rtol=1e-11)
    assert cuda.lines_vjp(x, y, lines, window, whole(x.shape[1:]), method).shape == lines.shape
