"""Results are as new as the code that they measure, or their page states it: "changed since"."""

import subprocess
from pathlib import Path

import pytest

import mvrecon

ROOT = Path(__file__).parents[2]
#: What the pages of each file of versions measure.
MEASURED = {
    "experiments/01_operators": ("README.md", ["mvrecon/kernels/rays", "mvrecon/operators"]),
    "experiments/05_skip": ("README.md", ["mvrecon/kernels/rays", "mvrecon/operators"]),
    "experiments/06_precision": ("README.md", ["mvrecon/kernels/rays", "mvrecon/operators"]),
    "experiments/14_counts": (
        "README.md",
        [
            "mvrecon/methods/classical/mlem.py",
            "plugins/mvrecon-spect/mvrecon_spect/kernels",
            "plugins/mvrecon-spect/mvrecon_spect/operators",
            "plugins/mvrecon-spect/mvrecon_spect/methods",
        ],
    ),
    "experiments/23_gpu": ("README.md", ["mvrecon/kernels"]),
    "docs/trust": ("../trust.md", ["mvrecon"]),
}
#: The words of a page whose results are of older code.
NOTE = "changed since"


def changed(*paths: str) -> int:
    """When any of these was changed, in seconds; 0 without git or history."""
    command = ["git", "log", "-1", "--format=%ct", "--", *paths]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    return int(done.stdout or 0) if done.returncode == 0 else 0


@pytest.mark.parametrize("folder", MEASURED)
def test_results_are_as_new_as_their_code_or_the_page_says_so(folder: str):
    page, code = MEASURED[folder]
    if NOTE in " ".join((ROOT / folder / page).read_text(encoding="utf-8").split()):
        return
    stamp = (ROOT / folder / "versions.txt").read_text(encoding="utf-8")
    versions = dict(line.split(maxsplit=1) for line in stamp.splitlines() if " " in line)
    assert versions.get("mvrecon", mvrecon.__version__) == mvrecon.__version__
    assert changed(f"{folder}/versions.txt") >= changed(*code)


def test_every_file_of_versions_is_compared():
    stamps = [*ROOT.glob("experiments/*/versions.txt"), *ROOT.glob("docs/*/versions.txt")]
    assert {str(stamp.parent.relative_to(ROOT)) for stamp in stamps} == set(MEASURED)
