"""Tests that guard a file, a folder, a setting or a run say so in one sentence: a row of
docs/trust.md.
"""

import ast
import json
from collections import Counter
from pathlib import Path

SAMPLE = '''
import pytest

@pytest.mark.door
@pytest.mark.parametrize("k", range(3))
def test_numbers(k):
    """A number below two is kept.

    More of it.
    """
    if k == 0:
        pytest.skip("not here")
    assert k < 2

@pytest.fixture
def broken():
    raise OSError("no file")

@pytest.mark.door
def test_files(broken):
    """A file is there."""

def test_no_door():
    """Is not told."""
'''


def facts(file: Path) -> list[str]:
    """First paragraphs of the docstrings of a file's doors; a door without one gives its name."""
    tree = ast.parse(file.read_text())
    functions = [node for node in ast.walk(tree) if isinstance(node, ast.FunctionDef)]
    lines = map(ast.unparse, tree.body)
    all_are = any("pytest.mark.door" in line for line in lines if line.startswith("pytestmark"))
    doors = [
        f
        for f in functions
        if (all_are and f.name.startswith("test_"))
        or any(ast.unparse(mark) == "pytest.mark.door" for mark in f.decorator_list)
    ]
    texts = [(ast.get_docstring(f) or f.name).partition("\n\n")[0] for f in doors]
    return [" ".join(text.split()) for text in texts]


def all_facts(root: Path) -> list[str]:
    """Of every door of mvrecon and its plugins."""
    folders = (root / "tests", *root.glob("plugins/*/tests"))
    return [text for folder in folders for f in folder.rglob("test_*.py") for text in facts(f)]


def test_the_page_on_trust_has_a_row_for_every_door(root):
    """A new door, or one that says something else: `python scripts/trust.py --doors FILE`."""
    table = (root / "docs" / "trust.md").read_text().split("\n## Doors")[1].split("\n## ")[0]
    rows = [line[2:].rsplit(" | ", 3)[0] for line in table.splitlines() if line.startswith("| ")]
    assert sorted(set(rows) - {"what holds", "---"}) == sorted(all_facts(root))


def test_a_door_says_its_fact_in_one_sentence_of_its_own(root):
    told = all_facts(root)
    assert len(told) > 20
    assert [text for text in told if not (text.endswith(".") and " " in text)] == []
    assert [text for text, times in Counter(told).items() if times > 1] == []


def test_the_verdicts_on_doors_are_counted_fact_by_fact(run_python, tmp_path):
    (tmp_path / "test_sample.py").write_text(SAMPLE)
    done = run_python("-m", "tests.doors", str(tmp_path))
    assert json.loads(done.stdout.splitlines()[-1]) == {
        "A number below two is kept.": {"pass": 1, "FAIL": 1, "n/a": 1},
        "A file is there.": {"pass": 0, "FAIL": 1, "n/a": 0},
    }
