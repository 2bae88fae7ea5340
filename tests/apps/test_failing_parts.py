"""Every command imports, builds and checks its parts before it changes a file: whatever part fails,
all files stay as they were, and no new run folder holds anything.
"""

import shutil
import sys

import pytest
import torch

import mvrecon.apps.compare
import mvrecon.apps.eval
import mvrecon.apps.reconstruct
import mvrecon.apps.simulate
import mvrecon.apps.train
import mvrecon.apps.view
import mvrecon.apps.warmup
from mvrecon.apps.config import compose
from mvrecon.core.parts import METHODS
from mvrecon.data.volume_files import save_volume
from mvrecon.geometry.grid import Grid
from mvrecon.training import checkpoints
from mvrecon.training.settings import TrainSettings
from tests.training.runs import call, contents

PLUGIN = """
from mvrecon.core.parts import METHODS
@METHODS.register("kept_part")
def kept_part(A, views):
    return A.T(views)
"""
RUN = (
    "experiment=smoke",
    "trainer.max_steps=1",
    "trainer.val_check_interval=1",
    "plugins=[kept_plugin]",
    "+compare.own.name=kept_part",
    "scene=volumes",
    "scene@test_scene=volumes",
    "data.sizes={train: 2, val: 1, test: 1}",
    "data.batch_size=1",
)


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    """A folder with a finished run, its plugin and its volumes, and a simulated scan."""
    folder = tmp_path_factory.mktemp("place")
    (folder / "kept_plugin.py").write_text(PLUGIN)
    body = torch.full((16, 16, 16), -1000.0)
    body[4:12, 4:12, 4:12] = 0.0
    (folder / "cts").mkdir()
    for name in "abc":
        save_volume(folder / "cts" / f"{name}.nii.gz", body, Grid.centred(16, spacing=8.0))
    paths = [f"{key}.path={folder}/cts" for key in ("scene", "test_scene")]
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(folder)
        mvrecon.apps.train.train(
            TrainSettings(**compose(*RUN, *paths, "data.overlap=true")), folder / "run"
        )
    options = ("scene=ellipsoids", "camera=circular_small", "grid={size: [8,8,8], spacing: 16.0}")
    assert call(mvrecon.apps.simulate, *options, f"hydra.run.dir={folder}/simulated") == 0
    shutil.copy(next(folder.glob("simulated/cases/*/views.h5")), folder)
    yield folder
    METHODS._parts.pop("kept_part", None)
    sys.modules.pop("kept_plugin", None)


def without_plugin(folder):
    (folder / "kept_plugin.py").unlink()


def with_another_plugin(folder):
    (folder / "kept_plugin.py").write_text("import mvrecon\n")


def with_a_broken_plugin(folder):
    (folder / "kept_plugin.py").write_text("import mvrecon\nimport sped\n")


def returns(what):
    def with_another_result(folder):
        (folder / "kept_plugin.py").write_text(PLUGIN.replace("A.T(views)", what))

    return with_another_result


def cut(path):
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def damaged_data(folder):
    cut(folder / "cts" / "a.nii.gz")


def damaged_weights(folder):
    cut(checkpoints.finished(folder / "run", "cross_view_small"))


def damaged_views(folder):
    cut(folder / "views.h5")


def rig_in_the_run_folder(folder):
    (folder / "mine").mkdir()
    text = (folder / "simulated" / "rig.json").read_text()
    (folder / "mine" / "rig.json").write_text(text + "\n")
    (folder / "link.json").symlink_to(folder / "mine" / "rig.json")


def nothing(folder):
    pass


GIVEN = ("camera=from_file", "camera.path={0}/mine/rig.json", "hydra.run.dir={0}/mine")
LINKED = ("camera=from_file", "camera.path={0}/link.json", "hydra.run.dir={0}/mine")
MORE = ("resume={0}/run", "trainer.max_steps=4")
EVAL = ("checkpoint={0}/run", "hydra.run.dir={0}/new")
NEW = ("experiment=smoke", "hydra.run.dir={0}/new")
OWN = (*NEW, "plugins=[kept_plugin]", "+compare.own.name=kept_part")
SCAN = ("views.path={0}/views.h5", "camera.path={0}/simulated/rig.json", "hydra.run.dir={0}/new")
CASE = ("scene=volumes", "scene.path={0}/cts", "camera=circular_small", "hydra.run.dir={0}/new")
TRAINED = ("method=trained", "method.checkpoint={0}/run", "grid={{size: [8,8,8], spacing: 16.0}}")


@pytest.mark.parametrize(
    ("app", "damage", "options", "message"),
    [
        (mvrecon.apps.train, without_plugin, MORE, "kept_plugin"),
        (mvrecon.apps.train, with_another_plugin, MORE, "kept_part"),
        (mvrecon.apps.train, with_a_broken_plugin, MORE, "sped"),
        (mvrecon.apps.train, damaged_data, MORE, "have changed since"),
        (mvrecon.apps.train, damaged_weights, MORE, "cross_view_small.ckpt"),
        (mvrecon.apps.train, with_another_plugin, MORE[:1], "kept_part"),
        (mvrecon.apps.train, damaged_weights, MORE[:1], "cross_view_small.ckpt"),
        (mvrecon.apps.train, nothing, (*NEW, "+optimizer.sped=1"), "sped"),
        (mvrecon.apps.train, nothing, (*NEW, "+trainer.sped=1"), "sped"),
        (mvrecon.apps.train, nothing, (*NEW, "trainer.accelerator=sped"), "sped"),
        (
            mvrecon.apps.train,
            nothing,
            (*NEW, *CASE[:2], "scene@test_scene=volumes", "test_scene.path={0}/nowhere"),
            "nowhere",
        ),
        (mvrecon.apps.train, nothing, (*NEW, "+callbacks.own.name=sped"), "sped"),
        (mvrecon.apps.train, nothing, (*NEW, "+loss.sped=1"), "sped"),
        (mvrecon.apps.train, nothing, (*NEW, "init_from={0}/nowhere"), "nowhere"),
        (mvrecon.apps.train, damaged_weights, (*NEW, "init_from={0}/run"), "cross_view_small.ckpt"),
        (mvrecon.apps.train, damaged_data, (*NEW, *CASE[:2], "data.overlap=true"), "a.nii.gz"),
        (mvrecon.apps.train, returns("None"), OWN, "own: Expected of kept_part a volume"),
        (mvrecon.apps.train, returns("A.T(views).numpy()"), OWN, "own: Expected of kept_part"),
        (mvrecon.apps.train, returns("A.T(views)[..., 1:]"), OWN, "own: Expected of kept_part"),
        (
            mvrecon.apps.train,
            damaged_weights,
            (*NEW, "+method@compare.old=trained", "compare.old.checkpoint={0}/run"),
            "cross_view_small.ckpt",
        ),
        (mvrecon.apps.eval, with_another_plugin, EVAL, "kept_part"),
        (mvrecon.apps.eval, damaged_weights, EVAL, "cross_view_small.ckpt"),
        (mvrecon.apps.eval, damaged_data, EVAL, "have changed since"),
        (mvrecon.apps.eval, nothing, (*EVAL, "+compare.more={{name: sirt, sped: 1}}"), "sped"),
        (mvrecon.apps.train, rig_in_the_run_folder, (NEW[0], *GIVEN), "an input"),
        (mvrecon.apps.simulate, rig_in_the_run_folder, ("scene=ellipsoids", *GIVEN), "an input"),
        (mvrecon.apps.simulate, rig_in_the_run_folder, ("scene=ellipsoids", *LINKED), "an input"),
        (mvrecon.apps.simulate, damaged_data, CASE, "a.nii.gz"),
        (mvrecon.apps.simulate, nothing, (*CASE, "camera=parallel", "rtk=true"), "cone"),
        (mvrecon.apps.simulate, nothing, (*CASE, "projector=drr", "projector.method=sped"), "sped"),
        (mvrecon.apps.reconstruct, damaged_views, SCAN, "views.h5"),
        (mvrecon.apps.reconstruct, nothing, (*SCAN, "plugins=[sped]"), "sped"),
        (mvrecon.apps.reconstruct, damaged_weights, (*SCAN, *TRAINED), "cross_view_small.ckpt"),
        (mvrecon.apps.reconstruct, without_plugin, (*SCAN, *TRAINED), "kept_plugin"),
        (mvrecon.apps.reconstruct, nothing, (*SCAN, "unit=sped"), "sped"),
        (mvrecon.apps.compare, nothing, ("{0}/run", "{0}/cts", "--out={0}/new"), "cts"),
        (mvrecon.apps.compare, nothing, ("{0}/run", "--reference=sped", "--out={0}/new"), "sped"),
        (mvrecon.apps.view, damaged_data, ("{0}/cts/a.nii.gz", "--out={0}/new.html"), "a.nii.gz"),
        (mvrecon.apps.warmup, nothing, ("--sped",), "sped"),
    ],
)
def test_a_failing_part_changes_no_file(
    place, tmp_path, monkeypatch, capsys, app, damage, options, message
):
    """Plugins that are gone, other or broken; damaged weights, volumes and views, and missing ones;
    wrong options of every kind of part; a plugin that returns anything but a volume;
    a rig in the run's own folder, under the name of a file that the run writes.
    """
    folder = tmp_path / "place"
    shutil.copytree(place, folder, ignore=shutil.ignore_patterns("__pycache__"))
    text = (folder / "run" / "config.yaml").read_text().replace(str(place), str(folder))
    (folder / "run" / "config.yaml").write_text(text)
    for file in (folder / "run").rglob("digests.json"):
        file.write_text(file.read_text().replace(str(place), str(folder)))
    damage(folder)
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(folder)
    parts = {name: part for name, part in METHODS._parts.items() if name != "kept_part"}
    monkeypatch.setattr(METHODS, "_parts", parts)
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    monkeypatch.delitem(sys.modules, "kept_plugin", raising=False)
    before, folders = contents(tmp_path), set(tmp_path.rglob("*/"))
    if app in (mvrecon.apps.compare, mvrecon.apps.view, mvrecon.apps.warmup):
        code = plainly(app, *(option.format(folder) for option in options))
    else:
        code = call(app, *(option.format(folder) for option in options))
    said = capsys.readouterr().err + str(code)
    assert code and message in said, said
    after = contents(tmp_path)
    assert set(tmp_path.rglob("*/")) == folders
    assert after == before, {p for p in {**before, **after} if after.get(p) != before.get(p)}


def plainly(app, *arguments):
    """The exit of an app that is not Hydra's."""
    try:
        return app.main(list(arguments))
    except SystemExit as stop:
        return stop.code


def test_a_comparison_that_refuses_the_rig_ends_a_training_before_anything_is_written(tmp_path):
    """FDK of cameras on a dome: nothing is trained, which would have no result table."""
    settings = TrainSettings(**compose("experiment=smoke", "+compare.f.name=fdk", "camera=dome"))
    with pytest.raises(ValueError, match="f: FDK needs sources on a circle"):
        mvrecon.apps.train.train(settings, tmp_path / "run")
    assert not (tmp_path / "run").exists()
