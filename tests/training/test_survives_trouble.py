"""Failures: the last valid checkpoint is kept, one line reports the error and its path, and the
exit status is not zero.
"""

import os
import shutil
import tempfile
from pathlib import Path

import pytest

from tests.training import lives

pytestmark = pytest.mark.long

SINGLE = {
    "term": (
        {"what": "term", "n": 8, "app": True},
        "Stopped by SIGTERM; the last good checkpoint is",
        8,
    ),
    "closed terminal": (
        {"what": "hang up", "n": 8, "app": True},
        "Stopped by SIGTERM; the last good checkpoint is",
        8,
    ),
    "judged": (
        {"what": "term in validation", "n": 3},
        "Stopped by SIGTERM; the last good checkpoint is",
        9,
    ),
    "disk": (
        {"what": "no space", "n": 13, "app": True},
        "OSError: [Errno 28] No space left on device: '{run}/checkpoints",
        6,
    ),
    "memory": ({"what": "no memory", "n": 8}, "MemoryError: no memory left", 6),
    "loss": (
        {"what": "nan", "n": 8},
        "FloatingPointError: The loss of geometry_free is not finite at step 8",
        6,
    ),
    "weights": ({"what": "nan", "n": 9}, "weights are not finite", 6),
}
WORKERS = {
    "worker": ({"what": "dead worker", "n": 12}, "exited unexpectedly with exit code 3", None),
    "job": (
        {"what": "term of a job", "n": 8},
        "Stopped by SIGTERM; the last good checkpoint is",
        8,
    ),
}


@pytest.fixture(scope="module", params=[0, 2])
def troubled(request, tmp_path_factory):
    """How the troubled lives ended, without and with worker processes."""
    folder = tmp_path_factory.mktemp("trouble")
    cases = WORKERS if request.param else SINGLE
    look = {"what": "look"}
    runs = {"whole": []} | {name: [fate, look] for name, (fate, _, _) in cases.items()}
    return folder, cases, lives.play(folder, runs, f"data.workers={request.param}")


def test_each_failure_is_reported_with_a_non_zero_exit(troubled):
    """Whatever breaks a training off, it ends with an error and the path of the last good
    checkpoint.
    """
    folder, cases, ended = troubled
    for name, (_, message, _) in cases.items():
        life, note = ended[name][0], "the last good checkpoint is"
        assert life["exit"] == (143 if "SIGTERM" in message else 1), name
        lines = life["said"].splitlines()
        assert any(message.format(run=folder / name) in line for line in lines), (
            name,
            life["said"],
        )
        assert any(note in line and "resume=" in line for line in lines), (name, life["said"])


def test_each_failure_leaves_the_last_valid_checkpoint_and_no_partial_file(troubled):
    """A failed training leaves its last valid checkpoint and no partial file."""
    _, cases, ended = troubled
    for name, (_, _, step) in cases.items():
        found = ended[name][1]
        assert found["parts"] == [], name
        assert step is None or found["said"].strip() == f"step {step}", name


def test_each_failed_run_resumes_to_the_bits_of_an_undisturbed_run(troubled):
    """A failed training resumes to the bits of an undisturbed one."""
    folder, cases, ended = troubled
    whole = lives.state(folder / "whole")
    for name in cases:
        assert ended[name][-1]["exit"] == 0, ended[name][-1]["said"]
        found = lives.state(folder / name)
        for key in (
            "loops",
            "epoch",
        ):  # after a save within an epoch Lightning counts epochs otherwise
            found[key] = whole[key]
        assert lives.different(whole, found) == [], name


def test_a_folder_that_cannot_be_written_to_is_named():
    """A folder that cannot be written to is named."""
    folder = Path(tempfile.mkdtemp())  # where another user comes, too: nothing holds root
    try:
        os.chmod(folder, 0o777)
        ended = lives.play(folder, {"run": [{"what": "step", "n": 8}, {"what": "read-only"}]})
        assert [life["exit"] for life in ended["run"]] == [-9, 1, 0]
        assert any(
            f"Permission denied: '{folder}/run/checkpoints/" in line
            for line in ended["run"][1]["said"].splitlines()
        )
    finally:
        shutil.rmtree(folder)
