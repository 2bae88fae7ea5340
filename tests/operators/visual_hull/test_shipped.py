"""The visual hull of every scene by every rig that mvrecon brings."""

import warnings
from pathlib import Path
from typing import Any

import pytest
import yaml

from mvrecon.core.parts import CAMERAS, SCENES
from mvrecon.geometry.grid import Grid
from mvrecon.operators.visual_hull.support import support_from_views

pytestmark = pytest.mark.slow  # all together

CONF = Path(__file__).parents[3] / "conf"


def shipped(kind: str) -> dict[str, dict[str, Any]]:
    """Configurations that need no file, by name."""
    configs = {
        file.stem: yaml.safe_load(file.read_text()) for file in sorted((CONF / kind).glob("*.yaml"))
    }
    return {name: config for name, config in configs.items() if "path" not in config}


SCENE, RIG = shipped("scene"), shipped("camera")
#: For a grid of 16^3: its rays are farther apart than the voxels below.
del RIG["circular_small"]


def lost(scene: dict[str, Any], rig: dict[str, Any], grid: Grid, cases: range) -> list[int]:
    """Voxels of each case that are not zero and lie outside the hull of its views."""
    cameras, source = CAMERAS.from_config(rig), SCENES.from_config(scene)
    counts = []
    for case in cases[: source.length]:
        sample = source.sample(case, 0, grid, cameras)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            mask = support_from_views(sample.views[None], cameras, grid, "hull").mask
        assert mask is not None
        assert not mask.all()
        counts.append(int(((sample.volume != 0) & ~mask[0]).sum()))
    return counts


@pytest.mark.pairwise(scene=SCENE, rig=RIG)
def test_no_shipped_rig_loses_a_voxel_of_a_shipped_scene(scene: str, rig: str):
    assert set(lost(SCENE[scene], RIG[rig], Grid.centred((32, 32, 32), 4.0), range(2))) == {0}


@pytest.mark.parametrize("cases", [range(1), pytest.param(range(1, 4), marks=pytest.mark.long)])
@pytest.mark.parametrize(
    ("rig", "options"),
    [("dcspect80", {}), ("dcspect80", {"pixels": 24}), ("parallel", {})],
    ids=str,
)
def test_wells_that_are_thinner_than_rays_are_apart_are_kept(
    rig: str, options: dict[str, Any], cases: range
):
    """Each of these was cut, by single views that missed a well."""
    grid = Grid.centred((64, 64, 64), 2.0)
    assert set(lost(SCENE["derenzo"], RIG[rig] | options, grid, cases)) == {0}
