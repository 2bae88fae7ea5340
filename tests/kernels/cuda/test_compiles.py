"""Every kernel of the CUDA back end is compiled for a device with none at hand: numba-cuda needs no
driver for it.
"""

from types import SimpleNamespace

import numpy as np
import pytest

pytest.importorskip("numba")
from numba import cuda, float32, float64, int32, int64, typeof, types  # noqa: E402

from mvrecon.kernels.rays.cuda import loops  # noqa: E402
from mvrecon.kernels.rays.cuda import operators as back_end  # noqa: E402
from mvrecon.kernels.rays.occupancy import Occupancy  # noqa: E402
from mvrecon.kernels.rays.trace import JOSEPH, SIDDON, TRILINEAR  # noqa: E402

SCENE = typeof(back_end.scene_of((0.0, 1.0), Occupancy.whole((8, 8, 8)), (16, 16), "trilinear:9"))
LINES = float64[:, :, :, ::1]
HOPPER = (9, 0)
METHODS = (JOSEPH, SIDDON, TRILINEAR)


def compilable() -> bool:
    if (
        getattr(cuda, "implementation", "") != "NVIDIA"
    ):  # numba's own CUDA target knows no min and max of two numbers
        return False
    try:
        cuda.compile_ptx(lambda x: None, types.void(float32), cc=HOPPER, device=False)
    except Exception:  # no compiler, or the simulator
        return False
    return True


pytestmark = pytest.mark.skipif(
    not compilable(), reason="needs numba-cuda with its compiler, pip install numba-cuda[cu13]"
)


@pytest.fixture(autouse=True)
def device(monkeypatch):
    """Functions that a kernel calls are compiled for the device at hand: say which it would be."""
    described = SimpleNamespace(compute_capability=HOPPER)
    monkeypatch.setattr("numba.cuda.dispatcher.get_current_device", lambda: described)


def assembly(kernel, *arguments) -> str:
    return cuda.compile_ptx(kernel.py_func, types.void(*arguments), cc=HOPPER, device=False)[0]


@pytest.mark.parametrize("method", METHODS)
def test_project_keeps_all_in_registers(method):
    kernel = loops.project_kernel(method, 4, np.uint32)
    text = assembly(kernel, float32[::1], LINES, SCENE, float32[:, :, :, ::1])
    assert "ld.local" not in text and "call" not in text
    assert (
        "div.rn.f64" in text and "rcp" not in text
    )  # a ray on a face stays on it: no division becomes a product


@pytest.mark.parametrize("method", METHODS)
def test_scatter_adds_atomically(method):
    kernel = loops.scatter_kernel(method, 1, np.uint64)
    text = assembly(kernel, float32[:, :, :, ::1], LINES, SCENE, float32[::1])
    assert (
        "atom.global.add.f32" in text or "red.global.add.f32" in text
    ) and "ld.local" not in text


def test_gather_needs_no_atomics():
    arguments = (
        float32[:, ::1],
        float32[:, ::1],
        float32[:, :, ::1],
        int32[:, ::1],
        SCENE,
        int64,
        float32[:, :, :, ::1],
    )
    text = assembly(loops.gather_kernel(4), *arguments)
    assert "atom." not in text and "red." not in text and "ld.local" not in text
    assert assembly(loops.record_kernel(), LINES, SCENE, int64, *arguments[1:4])


@pytest.mark.parametrize("method", METHODS)
def test_vary_compiles(method):
    kernel = loops.vary_kernel(method)
    assert assembly(
        kernel, float32[::1], float32[:, :, :, ::1], LINES, SCENE, float64[:, :, :, :, ::1]
    )
