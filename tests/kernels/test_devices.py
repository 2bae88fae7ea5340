"""Lines and footprints are computed on the device of the cameras, without synchronisation."""

from types import SimpleNamespace

import pytest

from mvrecon.kernels.rays.lines import lines_of
from mvrecon.operators.visual_hull.footprints import prints_of
from tests.kernels.cuda.waits import Waits
from tests.operators.rigs import CONE, GRID, PARALLEL


@pytest.mark.parametrize("rig", [CONE, PARALLEL], ids=["cone", "parallel"])
def test_tensors_derived_from_cameras_stay_on_their_device(rig):
    """On a device that refuses tensors of another; the grid's own numbers are in main memory."""
    tensors = {name: getattr(rig, name).to("meta") for name in ("source", "origin", "u", "v")}
    distance, frame = rig.distance.to("meta"), rig.frame.to("meta")
    away = SimpleNamespace(
        **tensors,
        shape=rig.shape,
        parallel=rig.parallel,
        ray_extent=rig.ray_extent,
        distance=distance,
        frame=frame,
    )
    with Waits() as waits:
        lines, numbers = lines_of(away, GRID), prints_of(away, GRID, 2.0).numbers
    assert lines.is_meta and lines.shape == (len(rig), 4, 3, 3)
    assert numbers.is_meta and numbers.shape == (len(rig), 17)
    assert waits.names == []
