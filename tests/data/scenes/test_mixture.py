from pathlib import Path

import pytest
import torch
import yaml

from mvrecon.core.parts import SCENES
from mvrecon.data.scenes.sample import Mixture

CONF = Path(__file__).parents[3] / "conf" / "scene"


def test_scenes_alternate(grid, rig):
    scene = Mixture(
        [{"name": "ellipsoids"}, {"name": "derenzo", "unit": "1/mm"}, {"name": "shepp_logan"}]
    )
    names = [scene.sample(i, 4, grid, rig).name for i in (5, 0, 1, 2, 3)]
    assert names == [
        "shepp_logan-4-0",
        "ellipsoids-4-0",
        "derenzo-4-1",
        "shepp_logan-4-0",
        "ellipsoids-4-3",
    ]
    own = SCENES.build("ellipsoids").sample(3, 4, grid, rig)
    assert torch.equal(scene.sample(3, 4, grid, rig).volume, own.volume)


def test_a_mixture_ends_with_its_last_scene():
    assert Mixture([{"name": "ellipsoids"}, {"name": "shepp_logan"}]).length is None
    assert Mixture([{"name": "shepp_logan"}, {"name": "shepp_logan", "field": 0.3}]).length == 2


@pytest.mark.parametrize(
    ("scenes", "message"),
    [
        ([], "at least one scene"),
        ([{"name": "ellipsoids"}, {"name": "derenzo"}], "unit"),
        ([{"name": "ellipsoids"}, {"name": "ellipsoids", "value": 2.0}], "data range"),
    ],
)
def test_invalid_mixtures_are_refused(scenes, message):
    with pytest.raises(ValueError, match=message):
        Mixture(scenes)


def test_an_unknown_scene_is_named():
    with pytest.raises(LookupError, match="did you mean 'ellipsoids'"):
        Mixture([{"name": "elipsoids"}])


@pytest.mark.parametrize("name", ["ellipsoids", "derenzo", "shepp_logan", "quickstart"])
def test_every_config_builds_a_scene(name, grid, rig):
    config = yaml.safe_load((CONF / f"{name}.yaml").read_text())
    scene = SCENES.from_config(config)
    assert scene.data_range == 1.0
    assert scene.sample(0, 0, grid, rig).views.isfinite().all()
