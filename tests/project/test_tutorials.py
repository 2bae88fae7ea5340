"""The tutorials run as they stand, and become pages and notebooks."""

import json
import re
import sys
from pathlib import Path

import pytest

from scripts.docs import site_pages, tutorials

#: Of repetitions that take long, the test runs a few.
FEWER = {"register": ("for _ in range(8):", "for _ in range(2):")}


@pytest.fixture
def as_before(registries: None, monkeypatch: pytest.MonkeyPatch):
    """What a tutorial registers, imports and puts on Python's path is gone after it."""
    monkeypatch.setattr(sys, "path", list(sys.path))
    yield
    for module in [name for name in sys.modules if name.partition(".")[0] == "my_plugin"]:
        del sys.modules[module]


@pytest.mark.parametrize("script", site_pages.TUTORIALS, ids=lambda script: script.stem)
def test_a_tutorial_runs_and_shows_what_it_printed_and_drew(
    script: Path, tmp_path: Path, as_before: None
):
    short, out = tmp_path / script.name, tmp_path / "page"
    once, fewer = FEWER.get(script.stem, ("", ""))
    assert once in script.read_text()
    short.write_text(script.read_text().replace(once, fewer))
    out.mkdir()
    text = tutorials.page(short, out)
    assert text.startswith("# ") and "```text\n" in text
    shown = set(re.findall(r"!\[.*\]\((.*)\)", text))
    assert shown == {file.name for file in out.iterdir()}
    assert shown


def test_a_notebook_has_the_cells_of_its_script():
    """Joined again, they are the script; the first is its title."""
    script = site_pages.TUTORIALS[0]
    cells = json.loads(tutorials.notebook(script))["cells"]
    assert {cell["cell_type"] for cell in cells} == {"markdown", "code"}
    assert len({cell["id"] for cell in cells}) == len(cells)
    assert cells[0]["source"][0].startswith("# ")
    code = "\n".join("".join(c["source"]) for c in cells if c["cell_type"] == "code")
    words = [line for line in script.read_text().splitlines() if not line.startswith("#")]
    assert code.split() == " ".join(words).split()


def test_a_tutorial_named_from_the_current_folder_draws_into_one_of_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    """As `bash scripts/docs/site.sh` names its folder: the cells run in another one."""
    monkeypatch.chdir(tmp_path)
    Path("red.py").write_text(
        "# %%\nfrom PIL import Image\n\nImage.new('RGB', (2, 2), 'red').save('dot.png')\n"
    )
    Path("pages").mkdir()
    assert "![red_dot.png](red_dot.png)" in tutorials.page(Path("red.py"), Path("pages"))
    assert Path("pages/red_dot.png").read_bytes().startswith(b"\x89PNG")
