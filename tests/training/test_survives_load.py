"""Many processes on the same files, and many runs in one process."""

import json
import os
import subprocess
import sys

import pytest
import yaml

from tests.training import crowd, lives

pytestmark = pytest.mark.long


@pytest.fixture
def crowded(root, tmp_path):
    """What the processes of a crowd answered."""

    def run(kind):
        command = [sys.executable, "-m", "tests.training.crowd", kind, str(tmp_path)]
        environment = {**os.environ, "OMP_NUM_THREADS": "1"}
        done = subprocess.run(
            command,
            cwd=root,
            env=environment,
            capture_output=True,
            text=True,
            timeout=900,
            check=False,
        )
        assert done.returncode == 0, done.stderr
        return json.loads(done.stdout.splitlines()[-1])

    return run


def test_readers_of_a_replaced_file_see_one_complete_version(crowded):
    """Readers of a volume file that is replaced meanwhile see one edition of it, whole."""
    answers = crowded("readers")
    assert len(answers) == 1 + crowd.READERS and all(code == 0 for code, _ in answers), answers
    assert all(int(times) >= 1 for _, times in answers[1:])


def test_concurrent_runs_of_one_sweep_write_their_own_results(crowded, tmp_path):
    """Concurrent runs of a sweep write their own results to their own folders."""
    answers = crowded("sweep")
    assert [code for code, _ in answers] == [0] * crowd.RUNS, answers
    assert len({answer.split()[1] for _, answer in answers}) == crowd.RUNS, (
        "four seeds, four results"
    )
    for k, (_, answer) in enumerate(answers):
        run = tmp_path / "sweep" / str(k)
        found = json.loads((run / "results.json").read_text())
        assert f"{found['seed']} {found['methods'][lives.METHOD]['psnr']['mean']}" == answer
        assert yaml.safe_load((run / "config.yaml").read_text())["seed"] == k


def test_only_one_of_several_runs_in_one_folder_proceeds_and_others_report_why(crowded, tmp_path):
    """Of several concurrent runs in one folder one proceeds, and the others are refused."""
    answers = crowded("folder")
    done = [answer for code, answer in answers if code == 0]
    refused = [answer for code, answer in answers if code]
    assert len(done) == 1 and len(refused) == crowd.RUNS - 1, answers
    assert all("is in use by process" in answer and "hydra.run.dir" in answer for answer in refused)
    found = json.loads((tmp_path / "sweep" / "same" / "results.json").read_text())
    assert str(found["seed"]) == done[0].split()[0]


def test_memory_is_constant_in_a_long_run(run_python):
    done = run_python("scripts/checks/soak.py", "--seconds", "1", "--allowed", "2")
    assert done.returncode == 0, done.stdout + done.stderr
    assert json.loads(done.stdout.splitlines()[-1])["rounds"] >= 7
