"""The tutorials run as they stand, and become pages and notebooks."""

import json
import re
import sys
from base64 import b64decode
from pathlib import Path
from typing import Any

import pytest

from scripts.docs import site_pages, tutorials

#: Of repetitions that take long, the test runs a few.
FEWER = {
    "register": ("for _ in range(8):", "for _ in range(2):"),
    "own_plugin": ("steps=50", "steps=35"),
    "own_training": ("steps, batch = 100, 4", "steps, batch = 50, 4"),
}


def notebook(file: Path) -> list[dict[str, Any]]:
    """The cells of a notebook."""
    return json.loads(file.read_text())["cells"]


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
    tutorials.write(short, out)
    text, cells = (out / f"{script.stem}.md").read_text(), notebook(out / f"{script.stem}.ipynb")
    assert text.startswith("# ") and "```text\n" in text
    shown = re.findall(r"!\[.*\]\((.*)\)", text)
    assert set(shown) == {file.name for file in out.glob("*.png")}
    assert shown
    outputs = [output for cell in cells for output in cell.get("outputs", ())]
    drawn = [output["data"]["image/png"] for output in outputs if "data" in output]
    assert [b64decode(image) for image in drawn] == [(out / name).read_bytes() for name in shown]
    printed = ["".join(output["text"]) for output in outputs if "text" in output]
    assert printed and all(f"```text\n{one}\n```" in text for one in printed)


def test_a_notebook_has_the_cells_of_its_script():
    """Joined again, they are the script; the first is its title."""
    script = site_pages.TUTORIALS[0]
    cells = json.loads(tutorials.notebook(tutorials.cells(script)))["cells"]
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
    tutorials.write(Path("red.py"), Path("pages"))
    assert "![red_dot.png](red_dot.png)" in Path("pages/red.md").read_text()
    assert Path("pages/red_dot.png").read_bytes().startswith(b"\x89PNG")
