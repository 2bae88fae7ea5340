"""The data of a run: no case is in two sets, and a resumed training uses the remaining cases."""

import lightning.pytorch as L
import pytest
import torch
from lightning.pytorch.callbacks import ModelCheckpoint

from mvrecon.data import digests
from mvrecon.data.module import SceneData
from tests.data.conftest import RIG

GRID = {"shape": [6, 6, 6], "spacing": 8.0}
MEASUREMENT = {"grid": GRID, "camera": RIG}
RANDOM = {"name": "ellipsoids"}


def build(scene=RANDOM, test_scene=None, seed=0, overlap=False, fresh=False, **sizes):
    scenes = {"train": scene, "test": test_scene or scene}
    sizes = {"train": 5, "val": 2, "test": 3, **sizes}
    return SceneData(
        scenes, MEASUREMENT, sizes, batch_size=2, overlap=overlap, seed=seed, fresh=fresh
    )


def names(loader):
    return [name for batch in loader for name in batch["name"]]


def parts(data):
    data.setup()
    return {
        "train": names(data.train_dataloader()),
        "val": names(data.val_dataloader()),
        "test": names(data.test_dataloader()),
    }


def disjoint(sets):
    return len({name for part in sets.values() for name in part}) == sum(map(len, sets.values()))


def test_random_scenes_have_separate_series():
    first, second = parts(build(seed=0)), parts(build(seed=1))
    assert [len(first[key]) for key in ("train", "val", "test")] == [5, 2, 3]
    assert disjoint(first) and disjoint(second)
    assert first["test"] == second["test"] and first["val"] == second["val"], (
        "all runs are judged on the same cases"
    )
    assert not set(first["train"]) & {name for part in second.values() for name in part}


def test_a_file_is_split_without_overlap(volume_file):
    heads = {"name": "hdf5", "path": str(volume_file)}
    sets = parts(build(heads, train=99))
    assert disjoint(sets)
    assert sets["val"] == ["pt_5", "pt_6"] and sets["test"] == ["pt_0"]
    assert sorted(sets["train"]) == ["pt_1", "pt_2", "pt_3", "pt_4"]


def test_a_path_object_names_a_file_as_its_text_does(volume_file, tmp_path):
    """One file with other options for the test is split, known by its digest, and cached."""
    scenes = {"train": {"name": "hdf5", "path": volume_file}}
    scenes["test"] = scenes["train"] | {"rays": 1}
    sizes = {"train": 9, "val": 2, "test": 3}
    data = SceneData(scenes, MEASUREMENT, sizes, cache=str(tmp_path / "cases"))
    assert disjoint(parts(data)) and len(list((tmp_path / "cases").iterdir())) == 7
    assert str(volume_file) in data.digests("test")


def test_asking_for_more_test_cases_never_takes_training_cases(volume_file):
    heads = {"name": "hdf5", "path": str(volume_file)}
    trained = set(build(heads, test=0).indices("train"))
    assert not trained & set(build(heads, test=99).indices("test"))
    same_file = {
        "name": "hdf5",
        "path": f"{volume_file.parent}/../{volume_file.parent.name}/heads.h5",
        "rays": 1,
    }
    assert not trained & set(build(heads, same_file, test=99).indices("test"))


def test_a_separate_test_file_leaves_all_other_cases_to_training(volume_file, tmp_path):
    other = tmp_path / "other.h5"
    other.write_bytes(volume_file.read_bytes())
    data = build(
        {"name": "hdf5", "path": str(volume_file)},
        {"name": "hdf5", "path": str(other)},
        train=99,
        test=4,
    )
    assert data.indices("train") == [0, 1, 2, 3, 4] and data.indices("val") == [5, 6]
    assert data.indices("test") == [0, 1, 2, 3]
    data.setup("test")
    assert set(data.sets) == {"test"}


def test_the_test_stage_does_not_need_the_training_file(volume_file):
    data = build({"name": "hdf5", "path": "gone.h5"}, {"name": "hdf5", "path": str(volume_file)})
    data.setup("test")
    assert names(data.test_dataloader()) == ["pt_0", "pt_1", "pt_2"]
    with pytest.raises(FileNotFoundError, match=r"gone\.h5"):
        data.setup("fit")


def test_varied_copies_are_only_of_training_cases(volume_file):
    data = build({"name": "hdf5", "path": str(volume_file), "vary": True}, train=23)
    train = data.indices("train")
    assert (
        len(set(train)) == 23
        and {i % 7 for i in train} == {1, 2, 3, 4}
        and train[:4] == [1, 2, 3, 4]
    )


def test_fresh_cases_are_new_copies_of_the_training_cases_in_every_epoch(volume_file):
    heads = {"name": "hdf5", "path": str(volume_file), "vary": True}
    data = build(heads, train=6, fresh=True)
    fixed, first = parts(build(heads, train=6)), parts(data)
    assert first["val"] == fixed["val"] and first["test"] == fixed["test"]
    assert sorted(first["train"]) == sorted(fixed["train"])
    loader = data.train_dataloader()
    loader.sampler.set_epoch(3)
    fourth = names(loader)
    assert len(fourth) == 6 and not set(fourth) & set(first["train"])
    assert {name.partition("-")[0] for name in fourth} == {"pt_1", "pt_2", "pt_3", "pt_4"}
    again = next(iter(loader))
    assert all(
        torch.equal(a, b) for a, b in zip(again["views"], next(iter(loader))["views"], strict=True)
    )
    known = data.sets["train"].prepare()["name"]
    assert known == ["pt_1", "pt_2", "pt_3", "pt_4"], "which tells what a network was trained on"


def test_fresh_cases_need_a_scene_that_varies(volume_file):
    heads = {"name": "hdf5", "path": str(volume_file)}
    with pytest.raises(ValueError, match="data.fresh=true, such as scene.vary=true"):
        build(heads, fresh=True).setup()


def test_a_file_that_is_too_small_is_refused(volume_file):
    heads = {"name": "hdf5", "path": str(volume_file)}
    with pytest.raises(ValueError, match=r"7 case\(s\) cannot be split: 1 to test .*last 7 to"):
        build(heads, val=7).indices("train")
    phantom = {"name": "shepp_logan"}
    with pytest.raises(ValueError, match=r"1 case\(s\) cannot be split"):
        build(phantom, val=0).indices("test")
    assert build(phantom, train=0, val=0).indices("test") == [0]


def test_one_volume_may_be_training_validation_and_test(volume_file):
    """With `overlap` all sets use the first cases of a file; only training uses varied copies."""
    heads = {"name": "hdf5", "path": str(volume_file)}
    data = build(heads, train=9, val=2, test=3, overlap=True)
    assert [data.indices(part) for part in ("train", "val", "test")] == [
        [0, 1, 2, 3, 4, 5, 6],
        [0, 1],
        [0, 1, 2],
    ]
    varied = build(heads | {"vary": True}, train=9, val=1, test=1, overlap=True)
    assert varied.indices("train") == [*range(9)] and varied.indices("val") == [0]
    sets = parts(build({"name": "shepp_logan"}, train=1, val=1, test=1, overlap=True))
    assert [len(names) for names in sets.values()] == [1, 1, 1]


def test_the_digest_of_a_folder_depends_on_contents_and_names(tmp_path):
    folder = tmp_path / "series"
    (folder / "more").mkdir(parents=True)
    (folder / "more" / "a.dcm").write_bytes(b"1")
    assert list(digests.files_in({"name": "some", "path": str(folder)})) == [str(folder)]
    first = digests.of_file(folder)
    (folder / "more" / "a.dcm").rename(folder / "more" / "b.dcm")
    second = digests.of_file(folder)
    (folder / "more" / "b.dcm").write_bytes(b"2")
    assert len({first, second, digests.of_file(folder)}) == 3


def test_wrong_settings_are_refused():
    with pytest.raises(
        ValueError, match="sizes must give train, val and test; missing or unknown: tset"
    ):
        build(tset=3)
    with pytest.raises(ValueError, match="at least 0, got sizes .*'val': -1"):
        build(val=-1)
    for wrong, message in (({"batch_size": 0}, "batch_size of at least 1"), ({"cash": 1}, "cache")):
        with pytest.raises((ValueError, TypeError), match=message):
            SceneData(
                {"train": RANDOM, "test": RANDOM},
                MEASUREMENT,
                dict.fromkeys(("train", "val", "test"), 1),
                **wrong,
            )
    with pytest.raises(ValueError, match="share their data_range"):
        build(RANDOM, {"name": "ellipsoids", "value": 0.5})
    with pytest.raises(ValueError, match="spacing must be positive"):
        SceneData(
            {"train": RANDOM, "test": RANDOM},
            {"grid": {"shape": [4, 4, 4], "spacing": -1.0}, "camera": RIG},
            dict.fromkeys(("train", "val", "test"), 1),
        )


def test_loading_does_not_use_the_global_random_numbers():
    data = build()
    data.setup()
    torch.manual_seed(5)
    expected = torch.rand(3)
    torch.manual_seed(5)
    names(data.train_dataloader()), names(data.val_dataloader())
    assert torch.equal(torch.rand(3), expected)


class Watching(L.LightningModule):
    """Writes down the cases that it is trained on; may break off."""

    def __init__(self, stop=None):
        super().__init__()
        self.weight, self.seen, self.stop = torch.nn.Parameter(torch.zeros(1)), [], stop

    def training_step(self, batch, batch_idx):
        if self.global_step == self.stop:
            raise RuntimeError("power cut")
        self.seen.append(batch["name"])
        return self.weight.sum()

    def validation_step(self, batch, batch_idx):
        return None

    def configure_optimizers(self):
        return torch.optim.SGD(self.parameters(), 0.1)


def run(folder, module, ckpt_path=None, every=2, fresh=False):
    keep = ModelCheckpoint(folder, "last", save_top_k=1, enable_version_counter=False)
    trainer = L.Trainer(
        max_steps=11,
        max_epochs=-1,
        val_check_interval=every,
        check_val_every_n_epoch=None,
        num_sanity_val_steps=0,
        callbacks=[keep],
        logger=False,
        enable_progress_bar=False,
        enable_model_summary=False,
        accelerator="cpu",
        default_root_dir=folder,
    )
    trainer.fit(module, datamodule=build(train=10, fresh=fresh), ckpt_path=ckpt_path)
    return module.seen


# within the first epoch, at its end, within the second one after a checkpoint in it, and before
@pytest.mark.parametrize(
    ("stop", "every", "fresh"), [(3, 2, True), (6, 5, False), (8, 2, False), (9, 3, True)]
)
def test_a_resumed_training_uses_the_cases_that_the_interrupted_one_missed(
    tmp_path, stop, every, fresh
):
    whole = run(tmp_path / "whole", Watching(), every=every, fresh=fresh)
    first, second = sum(whole[:5], []), sum(whole[5:10], [])
    assert len(whole) == 11 and whole[:5] != whole[5:10]
    if fresh:
        assert len({*first, *second}) == 20
    else:
        assert sorted(first) == sorted(second)
    with pytest.raises(RuntimeError, match="power cut"):
        run(tmp_path, Watching(stop), every=every, fresh=fresh)
    saved = stop - stop % every
    rest = run(tmp_path, Watching(), str(tmp_path / "last.ckpt"), every, fresh)
    assert rest == whole[saved:]
