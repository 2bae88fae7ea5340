"""The scripts for measuring on a GPU: they import, and say what they need."""

from pathlib import Path

import pytest
import torch

SCRIPTS = sorted((Path(__file__).parents[1] / "scripts" / "gpu").glob("*.py"))
RUN = {
    "check": ["--out", "OUT"],
    "models": ["--out", "OUT"],
    "operators": ["--out", "OUT"],
    "learn": ["--out", "OUT", "--train", "a.h5", "--test", "b.h5"],
}


def test_every_script_imports(run_python):
    names = [script.stem for script in SCRIPTS]
    code = f"import sys; sys.path.insert(0, 'scripts/gpu'); import {', '.join(names)}"
    done = run_python("-c", code)
    assert done.returncode == 0, done.stderr
    assert done.stdout == ""


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU")
@pytest.mark.parametrize("name", RUN)
def test_a_script_without_a_gpu_says_so(name: str, run_python, tmp_path: Path):
    """Before it makes anything."""
    out = tmp_path / "out"
    words = [str(out) if word == "OUT" else word for word in RUN[name]]
    done = run_python(f"scripts/gpu/{name}.py", *words)
    assert done.returncode == 1
    assert f"{name}.py needs a GPU, and torch" in done.stderr
    assert not out.exists()


@pytest.mark.skipif(torch.version.cuda is not None, reason="a build of torch with CUDA")
def test_waits_are_counted_by_a_build_with_cuda_alone(run_python):
    done = run_python("scripts/gpu/waits.py")
    assert done.returncode == 1
    assert "waits.py needs a build of torch with CUDA, got torch" in done.stderr
