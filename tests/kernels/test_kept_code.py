"""Machine code on disk: damaged files, a full disk and a folder that nobody may write to cost time,
never a number.
"""

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path
from typing import NamedTuple

import pytest

#: Prints the sum of a volume, and how many loops were compiled for it, of a process of these
#: sources (its own, if none are named) and so many bytes a file. The loops are short, the way to
#: the disk is that of every loop.
SCRIPT = """
import logging, resource, sys
from numba.core.caching import Cache
from mvrecon.kernels import compiling
sources, limit = sys.argv[1], int(sys.argv[2])
compiling.SOURCES = sources or compiling.SOURCES
if limit:
    resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))
save, compiled = Cache.save_overload, []
Cache.save_overload = lambda *inputs: (compiled.append(inputs), save(*inputs))[1]
logging.basicConfig(format="WARNED %(message)s", level="WARNING")
import torch
from mvrecon.kernels.differences import cpu
from mvrecon.kernels.differences import Shrinkage
volume, steps = torch.arange(210.0).sin().reshape(1, 1, 5, 6, 7), (1.0, 1.2, 0.9)
dual = cpu.dual_step(volume, torch.zeros(3, *volume.shape), 0.3, steps)
smooth = cpu.primal(volume, dual, Shrinkage(torch.ones(1, 1, 1, 1, 1), steps, False))
print(smooth.double().sum().item().hex(), len(compiled))
"""


class Outcome(NamedTuple):
    """What a process printed: the sum of its volume, how many loops it compiled, its warnings."""

    total: str
    compiled: int
    warned: list[str]


pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(sys.platform == "win32", reason="needs a limit of bytes a file"),
]


def run(code: Path, sources: str = "these", limit: int = 0) -> Outcome:
    """A volume by a process of its own, whose folder for machine code is `code`."""
    done = subprocess.run(
        [sys.executable, "-c", SCRIPT, sources, str(limit)],
        cwd=Path(__file__).parents[2],
        env={**os.environ, "NUMBA_CACHE_DIR": str(code)},
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )
    assert done.returncode == 0, done.stderr[-2000:]
    total, compiled = done.stdout.split()
    return Outcome(total, int(compiled), re.findall("WARNED (.*)", done.stderr))


@pytest.fixture(scope="module")
def kept(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    """A folder of machine code of these sources, and the sum of the volume by it."""
    folder = tmp_path_factory.mktemp("kept") / "code"
    total, compiled, warned = run(folder)
    assert compiled == 2 and not warned
    return folder, total


@pytest.fixture
def total(kept: tuple[Path, str]) -> str:
    """The sum of the volume by machine code that nothing befell."""
    return kept[1]


@pytest.fixture
def code(kept: tuple[Path, str], tmp_path: Path) -> Path:
    """A copy of the folder of machine code, with its times."""
    return Path(shutil.copytree(kept[0], tmp_path / "code"))


@pytest.mark.parametrize("ending", ["nbi", "nbc"])
def test_damaged_files_of_machine_code_are_written_anew(ending, code, total):
    """A cut or foreign index or file of compiled kernels costs a compilation and a warning, and is
    written anew.
    """
    one, other = sorted(code.rglob(f"*.{ending}"))
    one.write_bytes(one.read_bytes()[: one.stat().st_size // 2])
    other.write_bytes(b"\x80\x04 of another kind")
    again, anew, warned = run(code)
    assert (again, anew, len(warned)) == (total, 2, 1)
    assert run(code) == (total, 0, [])


@pytest.mark.parametrize("limit", [64, 5000])
def test_a_full_disk_leaves_no_machine_code_and_the_same_volume(limit, code, total):
    """Where compiled kernels find no room on disk, volumes are the same, with one warning; older
    code is never run.
    """
    again, anew, warned = run(code, "newer", limit)
    assert (again, anew, len(warned)) == (total, 2, 1) and "OSError" in warned[0]
    assert not list(code.rglob("*.nbi"))
    assert run(code, "newer") == (total, 2, []) and run(code, "newer") == (total, 0, [])


def test_a_folder_for_machine_code_that_is_a_file_changes_no_volume(code, total):
    """Where the folder for compiled kernels cannot be made, volumes are the same."""
    code.rename(code.with_name("moved"))
    code.touch()
    # in its place numba takes the folder of the sources, so that these must be the true ones
    assert run(code, sources="").total == total
