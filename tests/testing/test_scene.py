"""A scene that breaks its contract is caught, and the message says how."""

from dataclasses import replace

import pytest

from mvrecon.core.parts import SCENES
from mvrecon.data.scenes.phantoms import RandomEllipsoids
from mvrecon.testing import check_scene


def test_views_in_another_unit_are_detected(monkeypatch: pytest.MonkeyPatch):
    class InMetres(RandomEllipsoids):
        def sample(self, *arguments):
            case = super().sample(*arguments)
            return replace(case, views=case.views / 1000)

    monkeypatch.setattr(SCENES, "_parts", {"metres": InMetres})
    with pytest.raises(AssertionError, match="differ from line integrals of the truth"):
        check_scene("metres")
