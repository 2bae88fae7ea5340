"""Several devices, streams and threads: requests recorded by a mock driver."""

from types import SimpleNamespace

import pytest
import torch

from mvrecon.kernels.cuda import driver
from mvrecon.kernels.cuda.launch import Scene

SECOND = torch.device("cuda", 1)


class Listening:
    """A driver of several devices, whose contexts are 100, 101, ...; launches go to that of the
    device whose kernel it is.
    """

    def __init__(self, current: int | None):
        self.current, self.launched = current, []

    def cuCtxGetCurrent(self, context):
        context._obj.value = self.current
        return 0

    def cuDeviceGet(self, handle, ordinal):
        handle._obj.value = ordinal
        return 0

    def cuDevicePrimaryCtxRetain(self, context, handle):
        context._obj.value = 100 + handle.value
        return 0

    def cuCtxSetCurrent(self, context):
        self.current = context.value
        return 0

    def cuModuleLoadData(self, module, code):
        module._obj.value = self.current
        return 0

    def cuModuleGetFunction(self, function, module, name):
        function._obj.value = module.value
        return 0

    def cuLaunchKernel(self, function, *numbers):
        if self.current != function.value:
            return 201 if self.current is None else 400
        self.launched.append((self.current, numbers[7].value))
        return 0


@pytest.mark.parametrize(("current", "after"), [(100, 100), (101, 101), (None, 101)])
def test_launches_go_to_the_tensors_device_and_torch_s_stream_there(current, after, monkeypatch):
    """Whichever device is the current one, which stays so; a thread without one enters it."""
    stub = Listening(current)
    monkeypatch.setattr(driver, "library", lambda: stub)
    monkeypatch.setattr(
        torch.cuda, "current_stream", lambda device: SimpleNamespace(cuda_stream=7 + device.index)
    )
    project = driver.load(b"", ["project"], SECOND)["project"]
    assert stub.current == after
    stub.current = current
    for _ in range(2):
        driver.launch(project, Scene(), 1, 1, SECOND)
    assert stub.launched == [(101, 8)] * 2 and stub.current == after
