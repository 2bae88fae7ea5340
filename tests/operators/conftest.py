import pytest
import torch

from mvrecon.kernels.rays.cpu import skip_policy


@pytest.fixture
def threads():
    """Sets torch's number of threads for one test."""
    before = torch.get_num_threads()
    yield torch.set_num_threads
    torch.set_num_threads(before)


@pytest.fixture
def nothing_is_too_little(monkeypatch):
    """Small volumes are looked at, too."""
    monkeypatch.setattr(skip_policy, "SOME", 0)
    monkeypatch.setattr(skip_policy, "MUCH", 0)
