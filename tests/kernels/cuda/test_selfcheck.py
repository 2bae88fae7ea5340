"""The CUDA back end tries itself against the reference, once, before it is used."""

import pytest
import torch

from mvrecon.kernels.rays import reference
from mvrecon.kernels.rays.cuda import selfcheck
from tests.kernels.cuda.scenes import DEVICE, METHODS, SIMULATED, kernels


@kernels
@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize(("dtype", "volumes"), [(torch.float32, 1), (torch.float64, 3)])
def test_a_right_back_end_checks_itself_and_stays(method, dtype, volumes):
    selfcheck.forget()
    assert selfcheck.reason(DEVICE, method, dtype, volumes) is None


@kernels
def test_a_wrong_back_end_is_found_and_said_once(monkeypatch, caplog):
    from mvrecon.kernels.rays.cuda import operators as cuda

    selfcheck.forget()
    right = cuda.project
    monkeypatch.setattr(cuda, "project", lambda *arguments: right(*arguments) * 1.001)
    for _ in range(2):
        assert "project differs" in str(selfcheck.reason(DEVICE, "siddon"))
    assert len(caplog.records) == 1
    selfcheck.forget()


@pytest.mark.skipif(SIMULATED or DEVICE == "cuda", reason="there is a device")
def test_without_a_device_the_reason_is_recorded():
    selfcheck.forget()
    assert selfcheck.reason("cuda:0")
    selfcheck.forget()


@pytest.mark.skipif(SIMULATED, reason="is about torch")
def test_compiled_code_asks_while_it_is_traced():
    selfcheck.forget()
    missing = torch.device("cuda", 99)

    @torch.compile(backend="eager", fullgraph=True)
    def choose(x):
        return x + 1 if selfcheck.reason(missing, "joseph", x.dtype, len(x)) else x

    assert choose(torch.zeros(1)) == 1
    selfcheck.forget()


def test_the_scene_of_the_check_has_rays_of_every_main_axis():
    lines, window, detector, shape = selfcheck.tiny_scene("cpu")
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
def test_the_check_does_not_see_the_modes_of_the_call(mode, monkeypatch):
    """Matrix products and derivatives of the check are those of a fresh thread."""

    def differences(*case):
        x = torch.ones(2, 2, requires_grad=True)
        product = (x @ x).sum()
        (change,) = torch.autograd.grad(product, x)
        assert product.dtype == torch.float32 and not torch.is_inference(change)
        yield "a derivative", float((change - 4).abs().max())

    monkeypatch.setattr(selfcheck, "differences", differences)
    selfcheck.forget()
    reasons = []
    modes()[mode](lambda: reasons.append(selfcheck.reason("cpu")))
    selfcheck.forget()
    assert reasons == [None]


def test_a_full_memory_is_not_remembered(monkeypatch):
    full = [True]

    def differences(*case):
        if full:
            raise torch.OutOfMemoryError(f"no room, {full.pop()}")
        yield "nothing", 0.0

    monkeypatch.setattr(selfcheck, "differences", differences)
    selfcheck.forget()
    assert "no room" in str(selfcheck.reason("cpu")) and selfcheck.reason("cpu") is None
    selfcheck.forget()
