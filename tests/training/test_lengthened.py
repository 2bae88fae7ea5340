"""A finished run is continued to more steps."""

import json
import shutil

import pytest

import mvrecon.apps.train
from mvrecon.apps.config import compose
from mvrecon.training import checkpoints
from mvrecon.training.module import lr_factor
from mvrecon.training.settings import TrainSettings
from tests.training.lives import METHOD, OPTIONS
from tests.training.runs import call

#: Steps of the short training, in the middle of the second epoch of five; and of the long one.
SHORT, LONG = 7, 14
PLAIN = [option for option in OPTIONS if not option.startswith(("callbacks=", "trainer.max_s"))]


def steps(count, schedule):
    return [f"trainer.max_steps={count}", f"optimizer.schedule={schedule}", "optimizer.warmup=0"]


@pytest.fixture(scope="module")
def short(tmp_path_factory):
    """A finished run of few steps at a constant rate."""
    folder = tmp_path_factory.mktemp("short")
    mvrecon.apps.train.train(TrainSettings(**compose(*PLAIN, *steps(SHORT, "constant"))), folder)
    return folder


def kept(folder):
    """The weights and the optimiser's moments that a run ended with."""
    state = checkpoints.read(checkpoints.finished(folder, METHOD))
    moments = state["optimizer_states"][0]["state"]
    return state["state_dict"], {k: moments[k]["exp_avg_sq"] for k in moments}


def same(a, b):
    return all((x == y).all() for x, y in zip(a.values(), b.values(), strict=True))


def test_a_finished_run_continues_to_more_steps_as_if_never_finished(short, tmp_path, capsys):
    """At a constant learning rate, a finished run continued to more steps has the same bits as one
    of that length from the start; its table is new.
    """
    folder, whole = tmp_path / "run", tmp_path / "whole"
    shutil.copytree(short, folder)
    assert call(mvrecon.apps.train, f"resume={folder}", f"trainer.max_steps={LONG}") == 0
    said = capsys.readouterr().err
    assert f"{SHORT} steps become {LONG}" in said and f"resuming at step {SHORT}" in said
    mvrecon.apps.train.train(TrainSettings(**compose(*PLAIN, *steps(LONG, "constant"))), whole)
    assert all(map(same, kept(folder), kept(whole)))
    rows = [json.loads((f / "results.json").read_text())["methods"] for f in (folder, whole)]
    assert [row[METHOD]["train_steps"] for row in rows] == [LONG, LONG]
    assert rows[0][METHOD]["psnr"]["values"] == rows[1][METHOD]["psnr"]["values"]


def test_a_sweep_lengthens_finished_runs(short, tmp_path):
    """Of several runs, and in several steps; with as many steps as before it repeats none."""
    folders = [tmp_path / name for name in "ab"]
    for folder in folders:
        shutil.copytree(short, folder)
    sweep = ("-m", f"hydra.sweep.dir={tmp_path}/sweep", f"resume={folders[0]},{folders[1]}")
    for given in (SHORT + 1, f"{SHORT + 1},{SHORT + 2}"):
        assert call(mvrecon.apps.train, *sweep, f"trainer.max_steps={given}") == 0
    for folder in folders:
        row = json.loads((folder / "results.json").read_text())["methods"][METHOD]
        assert row["train_steps"] == SHORT + 2


@pytest.mark.parametrize("end", [SHORT, 10])
def test_averages_continue_from_the_trained_weights(end, tmp_path):
    """With averages of every other step, a run that ended within an epoch or at its end and is
    continued has the averages, the trained weights and the counters of one of that length. The
    trained weights used to begin again at the averages.
    """
    options = [*PLAIN, "callbacks=ema", "+callbacks.ema.update_every_n_steps=2"]
    folders = {"run": end, "whole": LONG}
    for name, count in folders.items():
        settings = TrainSettings(**compose(*options, *steps(count, "constant")))
        mvrecon.apps.train.train(settings, tmp_path / name)
    ended = checkpoints.read(checkpoints.finished(tmp_path / "run", METHOD))
    assert not same(ended["state_dict"], ended["current_model_state"])
    assert call(mvrecon.apps.train, f"resume={tmp_path}/run", f"trainer.max_steps={LONG}") == 0
    run, whole = (checkpoints.read(checkpoints.finished(tmp_path / n, METHOD)) for n in folders)
    for key in ("state_dict", "current_model_state", "averaging_state"):
        assert same(run[key], whole[key]), key


def test_a_run_can_only_be_lengthened(short, capsys):
    """A run is not resumed to fewer steps or with any other setting, and its table
    stays.
    """
    before = (short / "results.json").read_bytes()
    for options, message in (
        ([f"trainer.max_steps={SHORT - 1}"], f"expected more, got {SHORT - 1}"),
        ([f"trainer.max_steps={LONG}", "seed=1"], "for more steps; got seed=1"),
    ):
        assert call(mvrecon.apps.train, f"resume={short}", *options) == 1
        assert message in capsys.readouterr().err
    assert (short / "results.json").read_bytes() == before


def test_a_lengthened_training_uses_the_learning_rate_of_the_full_schedule(short):
    """At step 7 of 14 the cosine is at half of the highest rate, not where it ended at step 7."""
    folder = short.parent / "cosine"
    settings = TrainSettings(**compose(*PLAIN, *steps(SHORT, "cosine")))
    mvrecon.apps.train.train(settings, folder)
    rates = []
    step = mvrecon.training.module.ReconstructionModule.training_step
    with pytest.MonkeyPatch.context() as patch:

        def watched(module, batch, batch_idx):
            rates.append(module.optimizers().param_groups[0]["lr"])
            return step(module, batch, batch_idx)

        patch.setattr(mvrecon.training.module.ReconstructionModule, "training_step", watched)
        assert call(mvrecon.apps.train, f"resume={folder}", f"trainer.max_steps={LONG}") == 0
    highest = settings.optimizer["lr"]
    assert rates == [highest * lr_factor("cosine", n, LONG, 0.0) for n in range(SHORT, LONG)]
    assert rates[0] == pytest.approx(highest / 2)
