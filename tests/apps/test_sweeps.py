"""Sweeps: runs are named by the varied settings, not repeated, and may be run by other
processes.
"""

import json

import pytest

import mvrecon.apps.train
from mvrecon.apps import config
from mvrecon.training import fit
from tests.training.lives import OPTIONS
from tests.training.runs import call


@pytest.fixture(scope="module")
def sweep(tmp_path_factory):
    """A sweep over two seeds, and its command line."""
    folder = tmp_path_factory.mktemp("sweep") / "runs"
    options = ["-m", *OPTIONS, "trainer.max_steps=1", "seed=0,1", f"hydra.sweep.dir={folder}"]
    assert call(mvrecon.apps.train, *options) == 0
    return folder, options


def test_a_sweep_names_its_runs_by_what_it_varies_and_compares_them(sweep):
    folder, _ = sweep
    runs = {path.parent.name for path in folder.glob("*/results.json")}
    assert runs == {"seed=0", "seed=1"}
    page = (folder / "compare.md").read_text()
    assert all(f"| {name} | geometry_free |" in page for name in runs)


def test_a_restarted_sweep_runs_only_what_is_missing(sweep, monkeypatch):
    """A sweep restarted in its folder does not repeat finished runs."""
    folder, options = sweep
    before = (folder / "seed=0" / "results.json").read_text()
    (folder / "seed=1" / "results.json").unlink()
    seeds = []
    build = fit.build_data
    monkeypatch.setattr(fit, "build_data", lambda s: seeds.append(s.seed) or build(s))
    assert call(mvrecon.apps.train, *options) == 0
    assert seeds == [1] and (folder / "seed=0" / "results.json").read_text() == before


def test_sweepers_choose_by_validation_never_by_the_test(sweep):
    """What the app returns is the PSNR of validation scenes: others than those of the table."""
    table = json.loads((sweep[0] / "seed=0" / "results.json").read_text())
    assert mvrecon.apps.train._score(table) == table["validation_psnr"]
    assert table["validation_psnr"] not in table["methods"]["geometry_free"]["psnr"]["values"]


def test_a_sweep_chooses_experiments_from_elsewhere(tmp_path, monkeypatch):
    """Every job has the settings of its own experiment, and those of the command line."""
    (tmp_path / "experiment").mkdir()
    for name in ("first", "second"):
        text = f"# @package _global_\ndefaults: [override /method: sirt]\nname: of_{name}\n"
        (tmp_path / "experiment" / f"{name}.yaml").write_text(text)
    found = []
    options = ["-m", f"--config-dir={tmp_path}", "experiment=first,second", "seed=3"]
    monkeypatch.setattr("sys.argv", ["mvrecon-train", *options, f"hydra.sweep.dir={tmp_path}/runs"])
    config.launch(lambda c: found.append((c.name, c.method.name, c.seed)), "train")
    assert found == [("of_first", "sirt", 3), ("of_second", "sirt", 3)]


def test_all_values_of_a_sweep_are_checked_before_its_first_job(tmp_path, monkeypatch, capsys):
    """Of settings, of parts' options, and of choices."""
    monkeypatch.delenv("HYDRA_FULL_ERROR", raising=False)
    for varied, told in (
        ("seed=0,x", "seed: expected int >= 0, got 'x'"),
        ("optimizer.lr=0.1,fast", "optimizer.lr: expected float > 0, got 'fast'"),
        ("method=sirt,sart", "has no choice 'sart'; did you mean 'sirt'"),
    ):
        options = ["-m", varied, "data.batch_size=1,2", f"hydra.sweep.dir={tmp_path}/runs"]
        monkeypatch.setattr("sys.argv", ["mvrecon-train", *options])
        with pytest.raises(SystemExit):
            config.launch(lambda c: pytest.fail("a job began"), "train")
        assert told in capsys.readouterr().err and not (tmp_path / "runs").exists()
