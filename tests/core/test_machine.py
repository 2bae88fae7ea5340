"""Additional memory of a piece of work, independent of earlier use."""

import sys

import pytest
import torch

from mvrecon.core.machine import device_of, peak, peak_since, restarted_peak


@pytest.mark.skipif(sys.platform != "linux", reason="the other systems do not tell")
def test_memory_is_measured_per_piece_of_work():
    size = 64 * 2**20
    assert len(b"1" * (2 * size)) == 2 * size  # more than what is to be measured, and gone
    start = restarted_peak()
    work = b"2" * size
    needed = peak_since(start)
    assert needed is not None and size * 0.9 < needed < size * 1.1
    assert len(work) == size and peak_since(None) is None
    assert abs((peak() or 0) - (start or 0) - needed) < 2**20, "the count has begun anew"


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
