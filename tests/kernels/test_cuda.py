"""The kernels of the CUDA back end against the reference: on a device where there is one, else in
numba's simulator.

The simulator must be chosen before numba is imported, so one test runs this file again in a process
of its own.
"""

import os
import subprocess
import sys
from dataclasses import replace

import pytest
import torch

from mvrecon.cameras.camera import Cameras
from mvrecon.cameras.dcspect80 import dcspect80
from mvrecon.geometry.box import Box
from mvrecon.geometry.grid import Grid
from mvrecon.kernels.rays import reference, selfcheck
from mvrecon.kernels.rays.lines import lines_of
from mvrecon.kernels.rays.occupancy import Occupancy
from tests.projectors.rigs import GRID, PARALLEL, PINHOLES

SIMULATED = os.environ.get("NUMBA_ENABLE_CUDASIM") == "1"
DEVICE = "cuda" if torch.cuda.is_available() and not SIMULATED else "cpu"
kernels = pytest.mark.skipif(
    not SIMULATED and DEVICE == "cpu", reason="no CUDA device and no simulator"
)

whole = Occupancy.whole
SMALL = Grid.centred(size=(6, 4, 5), spacing=(1.0, 1.2, 0.9), centre=(3.0, -2.0, 4.0))
BODY = Grid.centred(size=(4, 5, 4), spacing=45.0)
RIGS = {
    "dome": (SMALL, PINHOLES[1:3]),
    "parallel": (SMALL, replace(PARALLEL[:2], extent="line")),
    "dcspect80": (BODY, dcspect80()[::40].binned(16)),
    "slice": (
        Grid.centred(size=(6, 5, 1), spacing=(1.0, 1.2, 0.9), centre=tuple(GRID.centre.tolist())),
        PARALLEL[:2],
    ),
}
METHODS = ("joseph", "siddon", "trilinear:8")  # of an odd number, one sample may lie on a kink
CASES = [(kind, method) for kind in RIGS for method in METHODS]


@pytest.fixture(autouse=True)
def few_threads(monkeypatch):
    """A thread of the simulator is one of the interpreter, so idle ones cost as much as busy
    ones.
    """
    if SIMULATED:
        monkeypatch.setattr("mvrecon.kernels.rays.cuda.BLOCK", 32)
        monkeypatch.setattr("mvrecon.kernels.rays.cuda_loops.BLOCK", 32)


def scene(kind: str, dtype: torch.dtype = torch.float64, count: int = 1):
    """Lines, window, detector, and volumes and views of noise."""
    torch.manual_seed(1)
    grid, cameras = RIGS[kind]
    x = torch.randn(count, *grid.shape, dtype=dtype, device=DEVICE)
    y = torch.randn(count, len(cameras), *cameras.shape, dtype=dtype, device=DEVICE)
    return x, y, lines_of(cameras, grid).to(DEVICE), list(cameras.ray_extent), list(cameras.shape)


def close(one: torch.Tensor, two: torch.Tensor, tolerance: float = 1e-11) -> bool:
    return two.abs().max() > 0 and torch.allclose(
        one, two, rtol=0, atol=tolerance * float(two.abs().max())
    )


@pytest.mark.skipif(SIMULATED, reason="is the simulator")
def test_in_the_simulator():
    pytest.importorskip("numba")
    # numba cannot compile the arrays of its simulator: everything runs as Python
    environment = os.environ | {
        "NUMBA_ENABLE_CUDASIM": "1",
        "NUMBA_DISABLE_JIT": "1",
        "PYTHONPATH": os.getcwd(),
    }
    environment.pop("PYTEST_XDIST_WORKER", None)
    command = [
        sys.executable,
        "-m",
        "pytest",
        "-q",
        "-x",
        "-p",
        "no:cacheprovider",
        "-p",
        "no:xdist",
        __file__,
    ]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=900)
    assert done.returncode == 0 and "passed" in done.stdout, (
        done.stdout[-4000:] + done.stderr[-2000:]
    )


@kernels
@pytest.mark.parametrize(("kind", "method"), CASES)
def test_project(kind, method):
    from mvrecon.kernels.rays import cuda

    x, _, lines, window, detector = scene(kind)
    expected = reference.project(x, lines, window, detector, method)
    assert close(cuda.project(x, lines, window, whole(x.shape[1:]), detector, method), expected)


@kernels
@pytest.mark.parametrize(("kind", "method"), CASES)
def test_backproject(kind, method):
    from mvrecon.kernels.rays import cuda

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
    """What is held of a volume is read and written as the rest of it would be, were it zero or left
    out.
    """
    from mvrecon.kernels.rays import cuda

    x, y, lines, window, detector = scene(kind)
    box = Box((1, 0, 2), (4, 2, 5))
    held, inside = Occupancy(whole(x.shape[1:]).shape, box), torch.zeros_like(x)
    inside[:, *box.slices] = 1
    part = x[:, *box.slices]
    moving = lines.clone().requires_grad_()
    views = reference.project(x * inside, moving, window, detector, method)
    assert close(cuda.project(part, lines, window, held, detector, method), views.detach())
    expected = reference.backproject(y, lines, window, list(x.shape[1:]), method)[:, *box.slices]
    assert close(cuda.scatter(y, lines, window, held, method), expected)
    assert close(cuda.backproject(y, lines, window, held, method), expected)
    (change,) = torch.autograd.grad((views * y).sum(), moving)
    assert close(cuda.lines_vjp(part, y, lines, window, held, method), change, 1e-9)


@kernels
@pytest.mark.parametrize("kind", ["dome", "parallel"])
def test_gather_in_pieces(kind, monkeypatch):
    from mvrecon.kernels.rays import cuda

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
    from mvrecon.kernels.rays import cuda

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
    from mvrecon.kernels.rays import cuda

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
    from mvrecon.kernels.rays import cuda

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
    from mvrecon.kernels.rays import cuda

    x, _, lines, window, _ = scene("dome")
    detector = [9, 17]
    expected = reference.project(x, lines, window, detector, method)
    assert close(cuda.project(x, lines, window, whole(x.shape[1:]), detector, method), expected)


@kernels
@pytest.mark.parametrize("method", METHODS)
def test_wide_indices_change_nothing(method, monkeypatch):
    """Volumes beyond 2^32 voxels are counted in 64 bits."""
    from mvrecon.kernels.rays import cuda

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
    from mvrecon.kernels.rays import cuda

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


@kernels
@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize(("dtype", "volumes"), [(torch.float32, 1), (torch.float64, 3)])
def test_a_right_back_end_checks_itself_and_stays(method, dtype, volumes):
    selfcheck._reason.cache_clear()
    assert selfcheck.reason(DEVICE, method, dtype, volumes) is None


@kernels
def test_a_wrong_back_end_is_found_and_said_once(monkeypatch, caplog):
    from mvrecon.kernels.rays import cuda

    selfcheck._reason.cache_clear()
    right = cuda.project
    monkeypatch.setattr(cuda, "project", lambda *arguments: right(*arguments) * 1.001)
    for _ in range(2):
        assert "project differs" in str(selfcheck.reason(DEVICE, "siddon"))
    assert len(caplog.records) == 1
    selfcheck._reason.cache_clear()


@pytest.mark.skipif(SIMULATED or DEVICE == "cuda", reason="there is a device")
def test_without_a_device_the_reason_is_recorded():
    selfcheck._reason.cache_clear()
    assert selfcheck.reason("cuda:0")
    selfcheck._reason.cache_clear()


@pytest.mark.skipif(SIMULATED, reason="is about torch")
def test_compiled_code_asks_while_it_is_traced():
    selfcheck._reason.cache_clear()
    missing = torch.device("cuda", 99)

    @torch.compile(backend="eager", fullgraph=True)
    def choose(x):
        return x + 1 if selfcheck.reason(missing, "joseph", x.dtype, len(x)) else x

    assert choose(torch.zeros(1)) == 1
    selfcheck._reason.cache_clear()


def test_the_scene_of_the_check_has_rays_of_every_main_axis():
    lines, window, detector, shape = selfcheck.tiny_scene("cpu")
    centre = lines[:, 0, :, 2].abs().argmax(dim=1)
    assert sorted(centre.tolist()) == [0, 1, 2]
    views = reference.project(
        torch.ones(1, *shape, dtype=torch.float64), lines, window, detector, "siddon"
    )
    assert ((views > 0).sum(dim=(2, 3)) > 10).all()


def rays_as_views(grid: Grid, cameras: Cameras) -> torch.Tensor:
    """Every ray of a rig as a view of one pixel: maps of the constant alone."""
    rows, columns = cameras.shape
    v, u = torch.meshgrid(
        torch.arange(rows) - (rows - 1) / 2,
        torch.arange(columns) - (columns - 1) / 2,
        indexing="ij",
    )
    p = torch.stack([u, v, torch.ones_like(u)], dim=-1).double().reshape(-1, 3)
    maps = torch.einsum("mkxc,rc->mrkx", lines_of(cameras, grid), p)
    return maps.flatten(0, 1)[..., None].contiguous().to(DEVICE)
