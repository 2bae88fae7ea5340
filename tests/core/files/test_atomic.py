"""A run folder is one process's at a time."""

import os

import pytest

from mvrecon.core.files.atomic import claimed

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
