"""Machine code on disk: damaged files, a full disk and a folder that nobody may write to cost time,
never a number.
"""

import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numba
import numpy as np
import pytest
from numba.core.caching import CompileResultCacheImpl
from numba.core.codegen import get_host_cpu_features

from mvrecon.kernels import compiling

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="needs a limit of bytes per file")


def running_sums(values):
    for k in range(1, len(values)):
        values[k] += values[k - 1]


def squares(values):
    for k in range(len(values)):
        values[k] *= values[k]


class Outcome(NamedTuple):
    """The sum that two loops gave, how many of them were compiled for it, the warnings."""

    total: float
    compiled: int
    warned: list[str]


@pytest.fixture
def run(monkeypatch, caplog) -> Callable[..., Outcome]:
    """Calls two loops as a new process does, which has compiled none yet. The loops are short; the
    way to the disk is that of every loop.
    """
    resource = pytest.importorskip("resource")
    monkeypatch.setattr(compiling.Kept, "announced", True)

    def call(code: Path, sources: str = "these", limit: int = 0) -> Outcome:
        """With a folder for machine code, of these sources, and so many bytes per file."""
        monkeypatch.setattr(numba.config, "CACHE_DIR", str(code))
        monkeypatch.setenv("NUMBA_CACHE_DIR", str(code))
        monkeypatch.setattr(compiling, "SOURCES", sources)
        monkeypatch.setattr(compiling.Kept, "warned", False)
        caplog.clear()
        loops = [compiling.compiled(loop) for loop in (running_sums, squares)]
        values = np.sin(np.arange(210.0))
        before = resource.getrlimit(resource.RLIMIT_FSIZE)
        try:
            if limit:
                resource.setrlimit(resource.RLIMIT_FSIZE, (limit, before[1]))
            for loop in loops:
                loop(values)
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, before)
        compiled = sum(loop.stats.cache_misses.total() for loop in loops)
        return Outcome(values.sum(), compiled, list(caplog.messages))

    return call


@pytest.fixture
def code(tmp_path: Path) -> Path:
    return tmp_path / "code"


@pytest.fixture
def total(run, code: Path) -> float:
    """The sum by loops compiled for it, now in `code`."""
    total, compiled, warned = run(code)
    assert compiled == 2 and not warned
    return total


def test_damaged_machine_code_files_are_rewritten(run, total, code):
    """A truncated or foreign file of compiled kernels causes a recompilation and a warning, and is
    rewritten.
    """
    one, other = sorted(code.rglob("*.nbc"))
    one.write_bytes(one.read_bytes()[: one.stat().st_size // 2])
    other.write_bytes(b"\x80\x04 of another kind")
    again, anew, warned = run(code)
    assert (again, anew, len(warned)) == (total, 2, 1)
    assert run(code) == (total, 0, [])


def test_a_killed_process_leaves_no_type_the_code_of_another(tmp_path, monkeypatch):
    """Of sources that have changed: numba's own files name a file in the index before it is
    written, and the name is that of older code, perhaps for another type.
    """
    older, newer = (compiling.CodeFiles(str(tmp_path), "loop", name) for name in ("older", "newer"))
    older.save("float64", "older code")

    def killed(*_):
        raise KeyboardInterrupt

    with monkeypatch.context() as kill, pytest.raises(KeyboardInterrupt):
        kill.setattr(newer, "_save_data", killed)
        newer.save("float32", "code")
    assert newer.load("float32") is newer.load("float64") is None
    newer.save("float32", "code")
    assert newer.load("float32") == "code" and newer.load("float64") is None
    assert len(list(tmp_path.iterdir())) == 1


def test_two_processes_that_compile_at_once_keep_both_types(tmp_path, monkeypatch):
    """Each has looked for files before the other writes its own."""
    one, other = (compiling.CodeFiles(str(tmp_path), "loop", "these") for _ in range(2))
    write = one._save_data

    def meanwhile(*arguments):
        other.save("float64", "code of float64")
        write(*arguments)

    monkeypatch.setattr(one, "_save_data", meanwhile)
    one.save("float32", "code of float32")
    assert [other.load(key) for key in ("float32", "float64")] == [
        "code of float32",
        "code of float64",
    ]


@pytest.mark.parametrize("limit", [64, 2000])
def test_a_full_disk_leaves_no_machine_code_and_the_same_volume(limit, run, total, code):
    """Where compiled kernels find no room on disk, volumes are the same, with one warning; older
    code is never run.
    """
    again, anew, warned = run(code, "newer", limit)
    assert (again, anew, len(warned)) == (total, 2, 1) and "OSError" in warned[0]
    assert run(code, "newer") == (total, 2, []) and run(code, "newer") == (total, 0, [])


def test_a_folder_for_machine_code_that_is_a_file_changes_no_volume(run, total, code):
    """Where the folder for compiled kernels cannot be made, volumes are the same."""
    code.rename(code.with_name("moved"))
    code.touch()
    # in its place numba takes the folder of the sources
    assert run(code).total == total


def test_without_a_writable_folder_each_command_says_once_how_to_keep_the_code(
    run, total, code, monkeypatch, capsys
):
    """Neither the variable's folder nor those of the sources and of the user can be written: numba
    finds no place. One line names the variable for all loops, and the volume is the same.
    """
    monkeypatch.setattr(CompileResultCacheImpl, "_locator_classes", [])
    for _ in range(2):
        monkeypatch.setattr(compiling.Kept, "announced", False)
        assert run(code) == (total, 2, [])
        (line,) = capsys.readouterr().err.splitlines()
        assert "at every command" in line and "NUMBA_CACHE_DIR=<folder>" in line


@pytest.mark.skipif(
    "+avx512f" not in get_host_cpu_features().split(",")
    or any(name in os.environ for name in ("NUMBA_CPU_NAME", "NUMBA_CPU_FEATURES")),
    reason="needs a processor with AVX-512, and no choice of another",
)
def test_loops_use_the_widest_vectors_of_the_processor():
    loop = numba.njit(**compiling.OPTIONS)(squares)
    loop(np.ones(64))
    assert all("zmm" in assembly for assembly in loop.inspect_asm().values())
