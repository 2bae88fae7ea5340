"""A projector that does not make the measured views is told."""

import pytest

from mvrecon.config import compose
from mvrecon.engine import agreement, fit
from tests.engine.lives import OPTIONS

pytestmark = pytest.mark.door


@pytest.mark.parametrize(("projector", "warned"), [("drr", False), ("halved", True)])
def test_a_projector_that_does_not_make_the_views_is_told(projector, warned, recwarn):
    """A run whose projector makes something else of the truth than the scene measures says so,
    once.
    """
    from mvrecon.parts import PROJECTORS
    from mvrecon.projectors.drr import Drr

    @PROJECTORS.register("halved")
    class Halved(Drr):
        def forward(self, volume):
            return super().forward(volume) / 2

    settings = compose(*OPTIONS)
    settings["projector"] = {"name": projector}
    agreement.warn_of_other_views(settings, fit.build_data(settings))
    lines = [str(w.message) for w in recwarn if "add up to" in str(w.message)]
    assert len(lines) == warned
    assert all(
        "projector=halved" in line and "line integrals (drr, radon)" in line for line in lines
    )
