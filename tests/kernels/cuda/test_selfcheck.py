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
    selfcheck._reason.cache_clear()
    assert selfcheck.reason(DEVICE, method, dtype, volumes) is None


@kernels
def test_a_wrong_back_end_is_found_and_said_once(monkeypatch, caplog):
    from mvrecon.kernels.rays.cuda import operators as cuda

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
