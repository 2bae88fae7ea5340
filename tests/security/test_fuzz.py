"""Damaged files of every kind: a reader reads them or reports an error, within memory limits and
without crashing.
"""

import json
import os
import subprocess
import sys
from pathlib import Path
from random import Random

import numpy as np
import pytest
import torch

from tests.faults.fuzz import mutations, tally, values
from tests.faults.samples import CHECKED

COUNT = 120
READERS = [
    *("HDF5 volumes", "NIfTI", "NIfTI, then packed", "NIfTI, packed", "cameras", "settings"),
    *("checkpoint", "checkpoint's pickle"),
    *("MHA", "NRRD", "pytorch-3dunet", "views, TIFF", "views, PNG", "views, NumPy", "views, HDF5"),
    *("views, DICOM", "views, NeXus", "views, Data Exchange", "views, OME-TIFF"),
    *("Nikon's geometry", "RTK's geometry", "angles", "scan.yaml", "VGStudio"),
]


@pytest.fixture(scope="module")
def survey(tmp_path_factory: pytest.TempPathFactory) -> tuple[dict, str]:
    """Results of every reader in a separate process, and how to reproduce them.

    The seed is random at night only: set MVRECON_FUZZ_SEED, and MVRECON_FUZZ_COUNT for more cases.
    """
    seed, count = (
        os.environ.get("MVRECON_FUZZ_SEED", "5"),
        os.environ.get("MVRECON_FUZZ_COUNT", str(COUNT)),
    )
    out = tmp_path_factory.mktemp("fuzz") / "found.json"
    command = [sys.executable, "-m", "tests.faults.fuzzing", seed, count, str(out)]
    done = subprocess.run(
        command, cwd=Path(__file__).parents[2], capture_output=True, text=True, check=False
    )
    found = json.loads(out.read_text()) if out.exists() else {}
    said = f"seed {seed}, exit status {done.returncode}\n{done.stderr[-2000:]}"
    return found, said


@pytest.mark.parametrize("reader", READERS)
def test_a_reader_survives_damaged_files(reader: str, survey: tuple[dict, str]):
    """A damaged file is read or refused with its name, within 256 MB, and the interpreter lives."""
    found, said = survey
    assert reader in found, said
    result = found[reader]
    assert not result["failures"], f"{said}\n" + "\n".join(result["failures"][:10])
    assert result["inputs"] >= COUNT and result["read"] < result["inputs"]
    assert result["peak"] < 2**28


def test_every_reader_is_fuzzed_and_the_process_succeeds(survey: tuple[dict, str]):
    found, said = survey
    assert sorted(found) == sorted(READERS) and "exit status 0" in said


def test_damage_depends_on_the_seed():
    data = bytes(range(256)) * 8
    first, again, other = (list(mutations(data, Random(seed), 60)) for seed in (1, 1, 2))
    assert first == again != other
    assert sum(case != data for case in first) > 50


@pytest.mark.parametrize("reader", CHECKED)
def test_a_damaged_file_with_checksums_is_refused_or_read_correctly(
    reader: str, survey: tuple[dict, str]
):
    """Volume files of mvrecon's, packed NIfTI and checkpoints: a damaged one is refused or has the
    same values.
    """
    failures = survey[0][reader]["failures"]
    assert not [line for line in failures if "other values" in line], survey[1]


def test_wrong_values_are_a_failure_for_formats_with_checksums(tmp_path: Path):
    whole = bytes(range(200))
    found = tally(Path.read_bytes, [whole, whole[1:]], tmp_path / "a.bin", whole)
    assert found.read == 2 and [line[:12] for line in found.failures] == ["case 1: read"]
    assert not tally(Path.read_bytes, [whole, whole[1:]], tmp_path / "a.bin").failures


def test_values_are_compared_bitwise():
    first, second = torch.zeros(3), torch.zeros(3)
    second[1] = 1e-45
    assert (
        values({"a": [first, np.ones(2)]})
        == values({"a": (torch.zeros(3), np.ones(2))})
        != values({"a": [second]})
    )
    assert values(first) != values(second) and values(first) != values(first.double())
    assert values(torch.nn.Linear(2, 2)) != values(torch.nn.Linear(2, 2))


def test_faults_of_a_bad_reader_are_detected(tmp_path: Path):
    def bad(path: Path) -> bytes:
        raw = path.read_bytes()
        if len(raw) < 100:
            raise ValueError("cut short")
        if len(raw) > 10_000:
            raise TypeError(f"{path} is long")
        return raw

    found = tally(bad, mutations(bytes(2000), Random(0), 60), tmp_path / "a.bin")
    kinds = {line.split(": ")[1].split()[0] for line in found.failures}
    assert found.inputs == 60 and kinds == {"ValueError", "TypeError"}
    assert 0 < found.read < 60
