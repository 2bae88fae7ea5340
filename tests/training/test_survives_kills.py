"""Training that is killed and resumed ends with the bits of an uninterrupted one.

`python -m tests.training.lives 240 7` does the same at large: 240 kills at random, seed 7.
"""

import csv
import os
import random
import signal
import sys

import pytest

from tests.training import lives

SEED = int(os.environ.get("MVRECON_SEED", "0"))
SHORT = ("trainer.max_steps=7", "data.workers=0")


def rows(folder):
    """The log, but for how long things took."""
    with open(folder / "metrics.csv", newline="") as file:
        return [
            {k: v for k, v in row.items() if not k.startswith("time/")}
            for row in csv.DictReader(file)
        ]


def test_a_training_killed_in_a_step_and_resumed_ends_with_the_same_bits(tmp_path):
    """A training that is killed in a step and resumed ends with the bits of an uninterrupted
    one.
    """
    ended = lives.play(
        tmp_path, {"whole": [], "killed": [{"what": "step", "n": 5}, {"what": "look"}]}, *SHORT
    )
    assert [life["exit"] for life in ended["whole"]] == [0]
    assert [life["exit"] for life in ended["killed"]] == [-signal.SIGKILL, 0, 0]
    assert ended["killed"][1]["said"] == "step 3", "it goes on from the last checkpoint"
    assert lives.different(lives.state(tmp_path / "whole"), lives.state(tmp_path / "killed")) == []


@pytest.mark.parametrize("every", [3, pytest.param(5, marks=pytest.mark.long)])
def test_a_training_stopped_before_a_validation_resumes_with_it(every, tmp_path):
    """Of several batches, within an epoch and at its end: the log has its row, there under the
    next epoch's number, and the run's best checkpoint is one of all.
    """
    options = (*SHORT, "data.sizes={train: 10, val: 6, test: 1}", "trainer.log_every_n_steps=1")
    options += (f"trainer.val_check_interval={every}", "callbacks=best")
    look = {"what": "look"}
    stopped = {"whole": [], "stopped": [{"what": "term", "n": every}, look]}
    ended = lives.play(tmp_path, stopped, *options)["stopped"]
    assert [life["exit"] for life in ended] == [143, 0, 0] and ended[1]["said"] == f"step {every}"
    whole, again = (
        [{k: v for k, v in row.items() if (k, every) != ("epoch", 5)} for row in rows(folder)]
        for folder in (tmp_path / name for name in stopped)
    )
    assert whole == again and sum(bool(row["val/psnr"]) for row in whole) == 7 // every
    states = [lives.state(tmp_path / name)["callbacks"] for name in stopped]
    best = [next(state[k] for k in state if k.startswith("ModelCheckpoint")) for state in states]
    assert best[0]["best_model_score"] == best[1]["best_model_score"]


@pytest.mark.long
@pytest.mark.parametrize("workers", [0, 2])
def test_kills_at_random_steps_and_while_writing_change_no_bit(workers, tmp_path):
    """A training that is killed in a step or while writing and resumed ends with the bits of an
    uninterrupted one.
    """
    rng = random.Random(f"{SEED} {workers}")
    first = rng.randrange(1, lives.STEPS)
    sys.stdout.write(f"seed {SEED}: killed at step {first}, then at others")
    fates = [{"what": "step", "n": first}, {"what": "rename", "n": 4}, {"what": "sync", "n": 5}]
    fates += [{"what": "byte", "n": rng.randint(20_000, 40_000)}, {"what": "stepped", "n": 2}]
    ended = lives.play(
        tmp_path,
        {"whole": [], "killed": fates},
        f"data.workers={workers}",
        "trainer.log_every_n_steps=1",
    )
    assert [life["exit"] for life in ended["whole"]] == [0]
    expected = [
        -signal.SIGKILL,
        -signal.SIGKILL,
        -signal.SIGKILL,
        -signal.SIGXFSZ,
        -signal.SIGKILL,
        0,
    ]
    assert [life["exit"] for life in ended["killed"]] == expected
    whole, killed = tmp_path / "whole", tmp_path / "killed"
    assert lives.different(lives.state(whole), lives.state(killed)) == []
    assert rows(whole) == rows(killed) and len(rows(whole)) > lives.STEPS
    left = {path.relative_to(killed) for path in killed.rglob("*") if ".hydra" not in path.parts}
    assert left == {
        path.relative_to(whole) for path in whole.rglob("*") if ".hydra" not in path.parts
    }
