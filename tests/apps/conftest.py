"""Runs of `mvrecon-reconstruct` without their pictures."""

import numpy as np
import pytest


@pytest.fixture
def blank_pictures(monkeypatch):
    """Rig and planes are not drawn, which takes longer than a small reconstruction."""
    blank = np.zeros((2, 2, 3), np.uint8)
    monkeypatch.setattr("mvrecon.report.viz.rig.picture", lambda *_: blank)
    monkeypatch.setattr("mvrecon.report.viz.review.scan", lambda *_: blank)
