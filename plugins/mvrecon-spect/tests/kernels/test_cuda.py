"""Attenuated rays on CUDA devices: the kernels compiled by g++ against the reference."""

import math
import shutil
from types import SimpleNamespace

import pytest
import torch

from mvrecon.kernels import self_test
from mvrecon.kernels.cuda import nvrtc
from mvrecon.kernels.cuda.launch import NAMES, Variant, kernels_of, text_of
from mvrecon.kernels.operator import choose_backend
from mvrecon_spect.kernels import cuda, ops, reference
from tests.kernels.cuda.host import compiled, stand_in
from tests.kernels.cuda.scenes import RIGS, difference, scene
from tests.kernels.cuda.waits import Waits

METHODS = ("joseph", "siddon", "distance_driven")
PRECISIONS = [(torch.float64, 1, 1e-11), (torch.float32, 3, 3e-6)]
#: Rigs whose rays all have one end of the volume on the detector's side, and none through voxels'
#: edges, where the derivative by mu has two values.
ONE_SIDED = [kind for kind in RIGS if kind != "axial"]


def variant(real, method):
    """The kernels for a type of arithmetic and a method."""
    if method == "distance_driven":
        return Variant(cuda.AREAS, real)
    return Variant(cuda.ATTENUATED, real, method=method)


#: What is compiled by g++.
VARIANTS = {
    f"_{NAMES[real]}_{method}": variant(real, method)
    for real in (torch.float32, torch.float64)
    for method in METHODS
}


@pytest.fixture(scope="module")
def libraries(tmp_path_factory):
    """The kernels by g++."""
    if shutil.which("g++") is None:
        pytest.skip("no C++ compiler")
    return compiled(tmp_path_factory.mktemp("attenuated"), VARIANTS)


@pytest.fixture
def host(libraries, monkeypatch, tmp_path):
    """An emulated device and its driver."""
    kernels_of.cache_clear()
    self_test.forget()
    yield stand_in(monkeypatch, libraries, tmp_path / "kernels", VARIANTS)
    kernels_of.cache_clear()
    self_test.forget()


def case(kind, dtype, count=1, layers=1, thickness=0.4):
    """Volumes, views, mu, and the rays of a rig; the whole volume is `thickness` thick on average
    along its diagonal, some voxels much more."""
    x, _, lines, window, detector = scene(kind, dtype, count)
    mu = torch.rand(x.shape[1:], dtype=dtype)
    mu[..., :2] *= 8
    mu *= thickness / (math.hypot(*RIGS[kind][0].spacing) * len(mu))
    y = torch.randn(count, len(lines), *detector, layers, dtype=dtype)
    nodes = torch.zeros(len(lines), 1, dtype=torch.float64)
    if layers > 1:
        shape = x.shape[1:]
        w = torch.stack(list(reference.fractions(lines, detector, shape)))
        inverse = (1 / w).unflatten(1, (len(lines), -1)).transpose(0, 1).flatten(1)
        low, high = inverse.quantile(0.1, dim=1), inverse.quantile(0.8, dim=1)
        nodes = low[:, None] + (high - low)[:, None] * torch.linspace(0, 1, layers).double()
    return x, y, mu, (lines, nodes, window, sum(RIGS[kind][0].spacing)), detector


@pytest.mark.parametrize(("dtype", "count", "bound"), PRECISIONS)
@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("kind", RIGS)
def test_views_and_volumes_match_the_reference(kind, method, dtype, count, bound, host):
    x, y, mu, rays, detector = case(kind, dtype, count)
    views = reference.project(x.double(), mu.double(), *rays, detector, method)
    assert difference(cuda.project(x, mu, *rays, detector, method), views) < bound
    volume = reference.backproject(y.double(), mu.double(), *rays, method)
    assert difference(cuda.backproject(y, mu, *rays, method), volume) < bound


@pytest.mark.parametrize(("dtype", "count", "bound"), PRECISIONS)
@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("kind", ONE_SIDED)
def test_the_attenuation_derivative_matches_the_reference(kind, method, dtype, count, bound, host):
    x, y, mu, rays, detector = case(kind, dtype, count)
    moving = mu.double().requires_grad_()
    views = reference.project(x.double(), moving, *rays, detector, method)
    (change,) = torch.autograd.grad((views * y).sum(), moving)
    assert difference(cuda.mu_vjp(x, y, mu, *rays, method), change) < bound


@pytest.mark.parametrize(("dtype", "count", "bound"), PRECISIONS)
@pytest.mark.parametrize("method", METHODS)
def test_layers_of_magnification_match_the_reference(method, dtype, count, bound, host):
    x, y, mu, rays, detector = case("dcspect80", dtype, count, layers=5)
    moving = mu.double().requires_grad_()
    views = reference.project(x.double(), moving, *rays, detector, method)
    assert difference(cuda.project(x, mu, *rays, detector, method), views) < bound
    volume = reference.backproject(y.double(), mu.double(), *rays, method)
    assert difference(cuda.backproject(y, mu, *rays, method), volume) < bound
    (change,) = torch.autograd.grad((views * y).sum(), moving)
    assert difference(cuda.mu_vjp(x, y, mu, *rays, method), change) < bound


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("kind", ["dcspect80", "cone"])
def test_high_attenuation_loses_no_precision(kind, method, host):
    """Up to a depth of 20, at which a ray's far end has lost all but 2e-9."""
    x, y, mu, rays, detector = case(kind, torch.float32, thickness=10.0)
    x = x.abs()
    views = reference.project(x.double(), mu.double(), *rays, detector, method)
    assert difference(cuda.project(x, mu, *rays, detector, method), views) < 3e-6
    volume = reference.backproject(y.double(), mu.double(), *rays, method)
    assert difference(cuda.backproject(y, mu, *rays, method), volume) < 3e-6


@pytest.mark.parametrize("scale", [1e-30, 1e30])
def test_fixed_point_supports_values_of_any_size(scale, host):
    x, y, mu, rays, _ = case("dcspect80", torch.float64, 2)
    volume = cuda.backproject(y, mu, *rays, "joseph")
    assert difference(cuda.backproject(scale * y, mu, *rays, "joseph"), scale * volume) < 1e-14
    change = cuda.mu_vjp(x, y, mu, *rays, "joseph")
    assert difference(cuda.mu_vjp(x, scale * y, mu, *rays, "joseph"), scale * change) < 1e-12
    assert difference(cuda.mu_vjp(scale * x, y, mu, *rays, "joseph"), scale * change) < 1e-12


def test_results_do_not_depend_on_the_order_of_views(host):
    """Whole numbers add up to the same in any order, as threads on a device have none."""
    _, y, mu, (lines, *rays), _ = case("dome", torch.float32, 2)
    volume = cuda.backproject(y, mu, lines, *rays, "joseph")
    turned = cuda.backproject(y.flip(1), mu, lines.flip(0), *rays, "joseph")
    assert torch.equal(volume, turned)


@pytest.mark.parametrize("bad", [math.nan, math.inf])
def test_non_finite_input_gives_nan(bad, host):
    x, y, mu, rays, detector = case("cone", torch.float32)
    y[0, 0, 1, 1], x[0, 2, 2, 2] = bad, bad
    assert cuda.backproject(y, mu, *rays, "joseph").isnan().all()
    assert cuda.mu_vjp(x, y, mu, *rays, "joseph").isnan().all()
    assert not cuda.project(x, mu, *rays, detector, "joseph").isfinite().all()


def test_zero_input_gives_zero_output_without_synchronisation(host):
    x, y, mu, rays, detector = case("cone", torch.float32, 2)
    with Waits() as waits:
        assert cuda.project(x[:0], mu, *rays, detector, "joseph").shape == (0, *y.shape[1:])
        views = cuda.project(0 * x, mu, *rays, detector, "joseph")
        volume = cuda.backproject(0 * y, mu, *rays, "joseph")
        change = cuda.mu_vjp(x, 0 * y, mu, *rays, "joseph")
    assert waits.names == []
    assert not views.any() and not volume.any() and not change.any()
    assert host.launches == [
        *("survey", "store"),
        *("survey", "store", "project"),
        *("survey", "store", "backproject"),
        *("survey", "store", "mu_vjp"),
    ]


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_attenuated_rays_check_themselves(dtype, host, monkeypatch):
    assert self_test.failure("cpu", "attenuated", dtype, ops.self_test) is None
    self_test.forget()
    right = cuda.backproject
    monkeypatch.setattr(cuda, "backproject", lambda *arguments: right(*arguments) * 1.001)
    why = self_test.failure("cpu", "attenuated", dtype, ops.self_test)
    assert "backproject differs from the reference" in str(why)
    x = SimpleNamespace(device=torch.device("cuda:0"), shape=(1, 1, 4, 4, 4), dtype=dtype)
    self_test.forget()
    host.failure["cuLaunchKernel"] = 222
    assert choose_backend(x, "auto", "attenuated", ops.self_test) == "reference"
    with pytest.raises(RuntimeError, match="backend 'cuda' cannot be used on cuda:0: "):
        choose_backend(x, "cuda", "attenuated", ops.self_test)


@pytest.fixture(scope="module")
def machine_code():
    """The module of mvrecon-bench that reads machine code."""
    module = pytest.importorskip("mvrecon_bench.gpu.machine_code")
    try:
        nvrtc.library(), module.disassembler()
    except OSError as problem:
        pytest.skip(str(problem))
    return module


@pytest.mark.parametrize(
    ("capability", "method"), [(80, "siddon"), (90, "joseph"), (90, "distance_driven")]
)
def test_attenuated_kernels_use_registers_and_single_precision(capability, method, machine_code):
    """As plain rays, but that a quotient's rare case is a call; numbers are added up whole."""
    text, count = text_of({"": variant(torch.float32, method)}), machine_code.count
    kernels = machine_code.compiled(text, capability)
    assert kernels.keys() == set(cuda.ATTENUATED.names)
    for name, kernel in kernels.items():
        assert kernel.registers <= 128, (name, kernel.registers)
        assert count(machine_code.LOCAL, kernel.instructions) <= 10, name
        for loop in kernel.loops:
            assert not count(machine_code.LOCAL + "|" + machine_code.DOUBLE, loop), name
        added = [i for i in kernel.instructions if "ADD.64" in i and "RED" in i]
        assert bool(added) == (name in ("backproject", "mu_vjp")), name
        assert not [i for i in kernel.instructions if "ADD.F" in i and "RED" in i], name
