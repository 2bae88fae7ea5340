"""What several tests of models share."""

import pytest

from mvrecon.core.parts import PROJECTORS
from tests.methods.learned.rig import small_rig


@pytest.fixture(scope="module")
def projector():
    grid, cameras = small_rig(size=24, pixels=36)
    return PROJECTORS.build("drr", grid=grid, cameras=cameras)
