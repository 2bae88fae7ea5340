"""Training cases of many rigs: each batch is of one rig, and its views are that rig's."""

import pytest
import torch

from mvrecon.core.parts import CAMERAS
from mvrecon.data.dataset import camera_of
from mvrecon.data.module import SceneData
from tests.geometry.cameras.rigs import OPTIONS

CAMERA = {"name": "random", **OPTIONS["random"], "seed": 5}
SCENE = {"name": "ellipsoids"}


def build(train=13, batch_size=2, rigs=3, camera=CAMERA, **loading):
    measurement = {"grid": {"shape": [6, 6, 6], "spacing": 8.0}, "camera": camera}
    sizes = {"train": train, "val": 1, "test": 1}
    loading |= {"batch_size": batch_size, "rigs": rigs}
    return SceneData({"train": SCENE, "test": SCENE}, measurement, sizes, **loading)


def test_every_batch_is_of_one_training_rig_and_every_epoch_has_all():
    data = build()
    data.setup("fit")
    loader = data.train_dataloader()
    epochs = []
    for epoch in range(2):
        loader.sampler.set_epoch(epoch)
        batches = list(loader)
        assert all(len(set(batch["rig"].tolist())) == 1 for batch in batches)
        epochs.append([(int(b["rig"][0]), name) for b in batches for name in b["name"]])
    assert sorted(epochs[0]) == sorted(epochs[1]) and epochs[0] != epochs[1]
    assert len(set(epochs[0])) == 12 and {rig for rig, _ in epochs[0]} == {1, 2, 3}
    assert "rig" not in next(iter(data.val_dataloader()))


def test_every_rig_gets_fresh_cases_in_every_epoch(tmp_path):
    """And the folder of kept cases gets none, since they never return."""
    data = build(fresh=True, cache=str(tmp_path))
    data.setup("fit")
    kept = len(list(tmp_path.iterdir()))
    loader, names = data.train_dataloader(), []
    for epoch in range(2):
        loader.sampler.set_epoch(epoch)
        batches = list(loader)
        assert {int(rig) for batch in batches for rig in batch["rig"]} == {1, 2, 3}
        names += [name for batch in batches for name in batch["name"]]
    assert len(set(names)) == len(names) == 24
    assert len(list(tmp_path.iterdir())) == kept == 1, "the validation case"


def test_the_views_of_a_case_are_those_of_its_rig():
    data = build()
    data.setup("fit")
    item = data.sets["train"][data.sets["train"].per_rig]  # the first of the second rig
    assert item["rig"] == 2
    rig = CAMERAS.from_config(camera_of(CAMERA, 2))
    sample = data._measured("train").sample(1, 2, data.grid, rig)
    assert item["name"] == sample.name and torch.equal(item["views"], sample.views)


def test_a_fixed_rig_and_rigs_without_a_batch_of_cases_are_refused():
    """Training on many rigs is refused for a fixed rig, and for rigs without a batch of cases."""
    circular = {"name": "circular", **OPTIONS["circular"]}
    with pytest.raises(ValueError, match="camera with a seed for data.rigs=3, .*got 'circular'"):
        build(camera=circular)
    with pytest.raises(ValueError, match="batch of 2 cases for each of 3 rigs, got 5"):
        build(train=5).setup("fit")
    assert build(camera=circular, rigs=0).rigs == []
