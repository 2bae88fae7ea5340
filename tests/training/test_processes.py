"""A training of several processes: one run, with the numbers of one process."""

import csv
import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest
import torch

import mvrecon.apps.train
from mvrecon.apps.config import compose
from mvrecon.data.dataset import EpochOrder
from mvrecon.training import fit as processes
from mvrecon.training.settings import TrainSettings
from tests.faults.fault_injection import different
from tests.training.lives import METHOD, OPTIONS, state

#: Without what makes a difference of rounding grow: plain gradient steps.
PLAIN = (*OPTIONS, "optimizer=sgd", "data.sizes.val=3", "trainer.log_every_n_steps=1")
TWO = ("trainer.devices=2", "trainer.strategy=ddp", "data.batch_size=1")


def app(*options, **environment):
    """`mvrecon-train` in a process of its own, as a user calls it."""
    command = [sys.executable, "-m", "mvrecon.apps.train", *options, "hydra/job_logging=none"]
    settings = {**os.environ, "OMP_NUM_THREADS": "2", **environment}
    root = Path(__file__).parents[2]
    return subprocess.run(
        command, cwd=root, env=settings, capture_output=True, text=True, check=False
    )


def log(folder, name):
    """The values of one figure in the order of their steps."""
    with open(folder / "metrics.csv", newline="") as file:
        return [float(row[name]) for row in csv.DictReader(file) if row.get(name)]


@pytest.fixture(scope="module")
def pair(tmp_path_factory):
    """The folders of one training by two processes and of the same by one, with twice the batch."""
    place = tmp_path_factory.mktemp("runs")
    done = app(*PLAIN, *TWO, "plugins=[tests.training.witness]", f"hydra.run.dir={place}/two")
    assert done.returncode == 0, done.stderr
    mvrecon.apps.train.train(TrainSettings(**compose(*PLAIN, "data.batch_size=2")), place / "one")
    return place / "two", place / "one"


@pytest.mark.slow
def test_two_processes_train_as_one_does_with_their_batches_together(pair):
    two, one = pair
    weights = [torch.load(two / f"weights{rank}.pt") for rank in (0, 1)]
    assert torch.equal(*weights), "both processes have the same weights"
    tables = [json.loads((folder / "results.json").read_text()) for folder in pair]
    rows = [table["methods"][METHOD] for table in tables]
    assert tables[0]["scenes"] == tables[1]["scenes"]
    assert rows[0]["train_steps"] == rows[1]["train_steps"] > 10
    for figure in ("psnr", "ssim", "nrmse", "view_nrmse"):
        assert rows[0][figure]["values"] == pytest.approx(
            rows[1][figure]["values"], rel=1e-6, abs=1e-6
        )
    for name in ("loss/total", "val/loss_total", "val/psnr", "val/ssim"):
        assert log(two, name) == pytest.approx(log(one, name), rel=1e-5), name
    assert tables[0]["validation_psnr"] == pytest.approx(log(one, "val/psnr")[-1], abs=0.5)


@pytest.mark.long
@pytest.mark.parametrize("rank", [0, 1])
def test_a_run_of_two_processes_one_of_which_is_killed_goes_on(pair, rank, tmp_path):
    """A run of several processes, whichever of them is killed, ends all of them and resumes with
    the bits of an unbroken one.
    """
    folder, plugin = tmp_path / "two", "plugins=[tests.training.witness]"
    broken = app(*PLAIN, *TWO, plugin, f"hydra.run.dir={folder}", MVRECON_KILL=f"{rank} 8")
    assert broken.returncode == (1 if rank else -signal.SIGKILL), broken.stderr
    assert not (folder / "results.json").exists()
    again = app(f"resume={folder}")
    assert again.returncode == 0, again.stderr
    assert "resuming at step 6" in again.stderr
    assert different(state(folder), state(pair[0])) == []


def test_the_error_of_a_lost_connection_names_the_process_that_ended():
    """The first process of a training says which other one was killed, and keeps the words on how
    to go on; an error of its own stays as it is.
    """
    error = RuntimeError("Read error: connection reset by peer")
    error.add_note("resume=run goes on")
    killed = "import os; os.kill(os.getpid(), 9)"
    for code, expected in ((killed, "lost process 1 .exit status -9."), ("", "by peer")):
        other = subprocess.Popen([sys.executable, "-c", code])
        with pytest.raises(RuntimeError, match=expected) as told, processes.lost([other]):
            raise error
        assert told.value.__notes__ == ["resume=run goes on"]


def test_processes_share_an_epoch_and_none_runs_out_of_cases_first():
    whole = list(EpochOrder(7, seed=3))
    shares = [EpochOrder(7, 3, rank, 3) for rank in range(3)]
    taken = list(zip(*shares, strict=True))
    assert [len(share) for share in shares] == [3, 3, 3]
    assert sum(map(list, taken), []) == whole + whole[:2]
    for share in shares:
        share.resume(0, 6)
    assert [list(share) for share in shares] == [[whole[6]], [whole[0]], [whole[1]]]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"strategy": "ddp_spawn"}, "strategy as one of .*got 'ddp_spawn'"),
        ({"num_nodes": 2}, "one process for each device, started by torchrun or srun"),
    ],
)
def test_ways_of_several_devices_that_were_never_tried_are_refused(options, message):
    """Strategies that write another kind of checkpoint, or that would train alone, are refused."""
    with pytest.raises(ValueError, match=message):
        processes.devices({"accelerator": "cpu", "devices": 2, **options})
