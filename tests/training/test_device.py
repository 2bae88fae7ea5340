"""One word for the device in every app."""

import pytest
import torch

from mvrecon.core.machine import device_of


def test_an_unavailable_device_is_refused(monkeypatch):
    """An evaluation on a misspelt device, or on a GPU that torch does not see, is refused with the
    known names.
    """
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    assert device_of("auto") == device_of("cpu") == "cpu"
    with pytest.raises(
        ValueError, match="'cuad'; did you mean 'cuda'. Known: auto, cpu, cuda, gpu"
    ):
        device_of("cuad")
    for name in ("gpu", "cuda"):
        with pytest.raises(ValueError, match=f"a GPU for device '{name}'"):
            device_of(name)
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    assert [device_of(name) for name in ("auto", "cpu", "gpu", "cuda")] == [
        "cuda",
        "cpu",
        "cuda",
        "cuda",
    ]
