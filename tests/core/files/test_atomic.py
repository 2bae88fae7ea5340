"""A run folder is one process's at a time."""

import os

import pytest

from mvrecon.core.files.atomic import claimed, written_whole

CLAIM = (
    "import sys, pathlib; from mvrecon.core.files.atomic import claimed\nwith "
    "claimed(pathlib.Path(sys.argv[1])): pass"
)


@pytest.mark.skipif(os.name != "posix", reason="folders are locked on POSIX systems alone")
def test_a_run_folder_is_locked_until_its_process_ends(run_python, tmp_path):
    """A second process in a run folder is refused with the id of the first, and may use the folder
    afterwards.
    """
    with claimed(tmp_path):
        refused = run_python("-c", CLAIM, str(tmp_path))
    assert refused.returncode == 1
    assert (
        f"is in use by process {os.getpid()} on" in refused.stderr
        and "hydra.run.dir" in refused.stderr
    )
    assert run_python("-c", CLAIM, str(tmp_path)).returncode == 0


@pytest.mark.parametrize("name", ["run", "sweep/date/run"])
def test_a_claim_removes_nothing_of_a_run_below(name, tmp_path):
    """The run in a subfolder writes on; leftovers of the claimed folder go. Tried: a training in
    outputs/ while another writes in outputs/<experiment>/<date>, and a sweep's folder.
    """
    run = tmp_path / name
    left = [tmp_path / ".results.json.1.part", tmp_path / "cases" / ".views.2.part" / "view.tif"]
    for path in left:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text("half")
    with claimed(run), written_whole(run / "checkpoints" / "last.ckpt") as part:
        part.write_text("whole")
        with claimed(tmp_path):
            pass
    assert (run / "checkpoints" / "last.ckpt").read_text() == "whole"
    assert not any(path.exists() for path in left)
