"""Every reconstructor of ours passes the check that a plugin's must."""

import pytest

import mvrecon as mv
from mvrecon.parts import RECONSTRUCTORS
from mvrecon.testing import check_reconstructor

DETECTOR = {"pixels": [12, 12], "pixel_mm": 8.0}
GRID = mv.Grid.centred(10, spacing=4.0)
CONE = mv.Drr(GRID, mv.circular(6, 200.0, 400.0, DETECTOR))
BEAM = mv.Radon(GRID, mv.parallel(6, {**DETECTOR, "pixel_mm": 4.0}))
#: A few iterations each; a trained network has no name alone.
OPTIONS = {"fbp": {}, "fdk": {}, "osem": {"iterations": 2}}


@pytest.mark.parametrize("name", sorted({*RECONSTRUCTORS.names()} - {"trained"}))
def test_contract(name: str):
    if not RECONSTRUCTORS.origin(name).startswith("mvrecon."):
        pytest.skip("a plugin's")
    check_reconstructor(
        name, BEAM if name == "fbp" else CONE, **OPTIONS.get(name, {"iterations": 5})
    )


def test_a_method_that_mixes_up_a_batch_is_told(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(RECONSTRUCTORS, "_parts", dict(RECONSTRUCTORS._parts))

    @RECONSTRUCTORS.register("mixed_up")
    def mixed_up(A, views):
        return mv.sirt(A, views, 5).flip(0)

    with pytest.raises(AssertionError, match="explains the views no better|depends on the others"):
        check_reconstructor("mixed_up", CONE)
