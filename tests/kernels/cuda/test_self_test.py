"""The CUDA back end tries itself against the reference, once, before it is used."""

from types import SimpleNamespace

import pytest
import torch

from mvrecon.kernels import self_test, voxels as voxel_ops, warps as warp_ops
from mvrecon.kernels.cuda import driver, nvrtc
from mvrecon.kernels.operator import choose_backend
from mvrecon.kernels.rays import ops, reference
from mvrecon.kernels.rays.cuda import operators as cuda
from mvrecon.kernels.voxels import cuda as voxel_cuda
from mvrecon.kernels.warps import cuda as warp_cuda
from tests.kernels.cuda.scenes import METHODS


def failure(method: str = "joseph") -> str | None:
    """Why the kernels of a method cannot be used."""
    return self_test.failure("cpu", method, torch.float32, ops.self_test)


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize(
    ("dtype", "volumes"),
    [(torch.float32, 1), (torch.float64, 3), (torch.float16, 1), (torch.bfloat16, 3)],
)
def test_a_correct_back_end_passes_its_check_and_is_used(method, dtype, volumes, host):
    purpose = method.partition(":")[0] + (ops.SEVERAL if volumes > 1 else "")
    assert self_test.failure("cpu", purpose, dtype, ops.self_test) is None


def test_a_compiled_graph_contains_the_check_result_as_a_constant(monkeypatch):
    def verdict(x):
        return x + (self_test.failure("cpu", "nothing", torch.float32, tests) is None)

    def tests(device, dtype, purpose):
        yield "nothing", 0.0

    monkeypatch.setattr(self_test, "_verdicts", {})
    compiled = torch.compile(verdict, backend="eager", fullgraph=True)
    assert compiled(torch.zeros(1)) == 1 and len(self_test._verdicts) == 1


def test_a_wrong_back_end_is_detected_and_reported_once(host, monkeypatch, caplog):
    right = cuda.project
    monkeypatch.setattr(cuda, "project", lambda *arguments: right(*arguments) * 1.001)
    for _ in range(2):
        assert "project differs" in str(failure("siddon"))
    assert len(caplog.records) == 1
    assert refused("project differs from the reference by 1.0e-03, expected at most 1e-04")


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a device")
def test_without_a_device_the_reason_is_recorded():
    self_test.forget()
    assert self_test.failure("cuda:0", "joseph", torch.float32, ops.self_test)
    self_test.forget()


def test_compiled_code_checks_the_back_end_while_tracing():
    self_test.forget()
    missing = torch.device("cuda", 99)

    @torch.compile(backend="eager", fullgraph=True)
    def choose(x):
        return x + 1 if self_test.failure(missing, "joseph", x.dtype, ops.self_test) else x

    assert choose(torch.zeros(1)) == 1
    self_test.forget()


def test_the_scene_of_the_check_has_rays_of_every_main_axis():
    lines, window, detector, shape = ops.tiny_scene("cpu")
    centre = lines[:, 0, :, 2].abs().argmax(dim=1)
    assert sorted(centre.tolist()) == [0, 1, 2]
    views = reference.project(
        torch.ones(1, *shape, dtype=torch.float64), lines, window, detector, "siddon"
    )
    assert ((views > 0).sum(dim=(2, 3)) > 10).all()


def modes():
    """What a process's first call may be inside of."""

    def mapped(ask):
        torch.func.vmap(lambda x: ask() or x)(torch.zeros(2, 1))

    def derived(ask):
        torch.func.grad(lambda x: ask() or x.sum())(torch.zeros(2))

    def within(mode):
        def run(ask):
            with mode:
                ask()

        return run

    autocast = torch.autocast("cpu", torch.bfloat16)
    return {
        "vmap": mapped,
        "grad": derived,
        "inference_mode": within(torch.inference_mode()),
        "no_grad": within(torch.no_grad()),
        "autocast": within(autocast),
    }


@pytest.mark.parametrize("mode", modes())
def test_a_first_call_in_any_mode_uses_the_kernels(mode, host):
    reasons = []
    modes()[mode](lambda: reasons.append(failure()))
    assert reasons == [None]


REASONS = {
    "no driver": (driver, "library", OSError("libcuda.so.1 cannot be loaded"), "libcuda.so.1"),
    "no compiler": (nvrtc, "build", OSError("NVRTC cannot be loaded"), "NVRTC cannot be loaded"),
    "an old compiler": (nvrtc, "capabilities", [100], "compute capability 10.0 and newer, got 9.0"),
}


def refused(words):
    """Whether "auto" takes the reference and "cuda" raises with the words, in one line; the tensor
    says that it is on a GPU, which the stand-in has in main memory.
    """
    x = SimpleNamespace(device=torch.device("cuda:0"), shape=(1, 1, 4, 4, 4), dtype=torch.float32)
    right = self_test.failure
    with pytest.MonkeyPatch.context() as patch, pytest.raises(RuntimeError) as error:
        patch.setattr(self_test, "failure", lambda device, *rest: right("cpu", *rest))
        assert ops.backend_for(x, "auto", "siddon") == "reference"
        ops.backend_for(x, "cuda", "siddon")
    line = str(error.value)
    assert line.startswith("backend 'cuda' cannot be used on cuda:0: ") and "\n" not in line
    return words in line


@pytest.mark.parametrize("what", REASONS)
def test_a_missing_component_is_reported_as_the_reason(what, host, monkeypatch):
    """Without a driver or a compiler, or with an old one, `auto` takes the reference and `cuda`
    raises with the reason.
    """
    module, name, result, words = REASONS[what]

    def fail(*_):
        if isinstance(result, OSError):
            raise result
        return result

    monkeypatch.setattr(module, name, fail)
    assert words in str(failure()) and refused(words)
    monkeypatch.undo()
    assert words in str(failure())  # it is remembered


REFUSALS = {
    "cuModuleLoadData": "CUDA's driver, of CUDA 12.2, does not take kernels by NVRTC 0.0: a reason "
    "(error 222)",
    "cuLaunchKernel": "CUDA's driver: a reason (error 222)",
}


@pytest.mark.parametrize("call", REFUSALS)
def test_a_driver_error_is_reported_as_the_reason(call, host):
    """Kernels that an old driver does not take, or a device does not start, are not used, and the
    reason names both versions.
    """
    host.failure[call] = 222
    assert REFUSALS[call] in str(failure()) and refused(REFUSALS[call])


@pytest.mark.parametrize("call", REFUSALS)
def test_an_out_of_memory_error_is_not_cached(call, host):
    """An out-of-memory error is reported but not cached, since it may be temporary."""
    host.failure[call] = driver.OUT_OF_MEMORY
    assert "out of memory" in str(failure()) and refused("out of memory")
    host.failure.clear()
    assert failure() is None


FAMILIES = [
    (warp_ops, warp_cuda, "warp_transpose"),
    (voxel_ops, voxel_cuda, "project"),
]


@pytest.mark.parametrize(("declared", "cuda", "name"), FAMILIES)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_warps_and_back_projection_check_themselves(declared, cuda, name, dtype, host, monkeypatch):
    purpose, tests = declared.__name__, declared.self_test
    assert self_test.failure("cpu", purpose, dtype, tests) is None
    self_test.forget()
    right = getattr(cuda, name)
    monkeypatch.setattr(cuda, name, lambda *arguments: right(*arguments) * 1.001)
    why = self_test.failure("cpu", purpose, dtype, tests)
    assert f"{name} differs from the reference" in str(why)
    x = SimpleNamespace(device=torch.device("cuda:0"), shape=(1, 1, 4, 4, 4), dtype=dtype)
    self_test.forget()
    host.failure["cuLaunchKernel"] = 222
    assert choose_backend(x, "auto", purpose, tests) == "reference"
    with pytest.raises(RuntimeError, match="backend 'cuda' cannot be used on cuda:0: "):
        choose_backend(x, "cuda", purpose, tests)
