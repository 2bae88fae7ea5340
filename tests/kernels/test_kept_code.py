"""Machine code on disk: damaged files, a full disk and a folder that nobody may write to cost time,
never a number.
"""

import os
import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

#: Prints the sum of views, and how many loops were compiled, of a process of these sources and so
#: many bytes a file.
SCRIPT = """
import logging, resource, sys
from numba.core.caching import Cache
from mvrecon.kernels import compiling
sources, limit = sys.argv[1], int(sys.argv[2])
compiling.SOURCES = sources
if limit:
    resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))
save, compiled = Cache.save_overload, []
Cache.save_overload = lambda *inputs: (compiled.append(inputs), save(*inputs))[1]
logging.basicConfig(format="WARNED %(message)s", level="WARNING")
import torch
from mvrecon.cameras.rigs import circular
from mvrecon.geometry.grid import Grid
from mvrecon.parts import PROJECTORS
rig = circular(3, 40.0, 70.0, {"pixels": [5, 6], "pixel_mm": 2.0}, start_degrees=13.0)
grid = Grid.centred(size=(7, 6, 5), spacing=1.0)
A = PROJECTORS.build("drr", grid=grid, cameras=rig, backend="cpu")
views = A(torch.arange(210.0).reshape(1, 1, 5, 6, 7) / 210)
print(views.double().sum().item().hex(), len(compiled))
"""
Run = Callable[..., tuple[str, int, list[str]]]
pytestmark = [
    pytest.mark.door,
    pytest.mark.slow,
    pytest.mark.skipif(sys.platform == "win32", reason="needs a limit of bytes a file"),
]


@pytest.fixture
def code(tmp_path: Path) -> Path:
    """A folder for machine code."""
    return tmp_path / "code"


@pytest.fixture
def run(code: Path, root: Path) -> Run:
    """The sum of views from a process of its own, the number of loops that it compiled, and its
    warnings.
    """

    def run(sources: str = "these", limit: int = 0) -> tuple[str, int, list[str]]:
        environment = {**os.environ, "NUMBA_CACHE_DIR": str(code)}
        command = [sys.executable, "-c", SCRIPT, sources, str(limit)]
        done = subprocess.run(
            command,
            cwd=root,
            env=environment,
            capture_output=True,
            text=True,
            timeout=300,
            check=False,
        )
        assert done.returncode == 0, done.stderr[-2000:]
        total, compiled = done.stdout.split()
        return total, int(compiled), re.findall("WARNED (.*)", done.stderr)

    return run


@pytest.mark.parametrize("ending", ["nbi", "nbc"])
def test_damaged_files_of_machine_code_are_written_anew(ending, run, code):
    """A cut or foreign index or file of compiled kernels costs a compilation and a warning, and is
    written anew.
    """
    total, compiled, warned = run()
    assert compiled == 2 and not warned
    one, other = sorted(code.rglob(f"*.{ending}"))
    one.write_bytes(one.read_bytes()[: one.stat().st_size // 2])
    other.write_bytes(b"\x80\x04 of another kind")
    again, anew, warned = run()
    assert (again, anew, len(warned)) == (total, compiled, 1)
    assert run() == (total, 0, [])


@pytest.mark.parametrize("limit", [64, 5000])
def test_a_full_disk_leaves_no_machine_code_and_the_same_views(limit, run, code):
    """Where compiled kernels find no room on disk, views are the same, with one warning; older code
    is never run.
    """
    total, compiled, _ = run(sources="older")
    again, anew, warned = run(limit=limit)
    assert (again, anew, len(warned)) == (total, compiled, 1) and "OSError" in warned[0]
    assert not list(code.rglob("*.nbi"))
    assert run() == (total, compiled, []) and run() == (total, 0, [])


def test_a_folder_for_machine_code_that_is_a_file_changes_no_view(run, code):
    """Where the folder for compiled kernels cannot be made, views are the same."""
    total, compiled, _ = run()
    code.rename(code.with_name("moved"))
    code.touch()
    assert run()[:1] == (total,)
