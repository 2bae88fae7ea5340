"""One projector in several threads: skipping is determined per thread."""

import pytest
import torch

from mvrecon.geometry.grid import Box
from mvrecon.operators.ray_transform import RayTransform
from tests.operators.sparse import CASES, volumes


@pytest.mark.usefixtures("nothing_is_too_little")
def test_skipping_of_one_thread_does_not_affect_another(monkeypatch):
    A = CASES["cone"].build(skip="box")
    x = volumes("blob")
    expected = A(x)
    A(x.flip(2, 3, 4))
    elsewhere = A._last
    monkeypatch.setattr(
        RayTransform, "_last", property(lambda _: elsewhere, lambda *_: None), raising=False
    )
    assert A.skipped.box != Box.around(x[0, 0] != 0)
    assert torch.equal(A(x), expected)
