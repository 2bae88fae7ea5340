"""Tutorials as pages and notebooks: python scripts/docs/tutorials.py SCRIPT OUT_FOLDER

A tutorial is a script in docs/tutorials whose cells begin with `# %%`, of text with
`# %% [markdown]`, as editors, jupytext and this file read them. The page shows each cell with what
it printed and the pictures that it saved.
"""

import io
import json
import re
import sys
from collections.abc import Iterator
from contextlib import chdir, redirect_stdout
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple


class Cell(NamedTuple):
    """One cell of a tutorial: Markdown or Python, its text, and the line it begins at."""

    kind: str
    text: str
    line: int


def cells(script: Path) -> Iterator[Cell]:
    """The cells of a script, in turn."""
    text = script.read_text(encoding="utf-8")
    marks = list(re.finditer(r"^# %%( \[markdown\])?\n", text, re.M))
    ends = [mark.start() for mark in marks[1:]] + [len(text)]
    for mark, end in zip(marks, ends, strict=True):
        body, line = text[mark.end() : end].strip("\n"), text.count("\n", 0, mark.end())
        if mark[1]:
            yield Cell("markdown", re.sub(r"^# ?", "", body, flags=re.M), line)
        else:
            yield Cell("code", body, line)


def page(script: Path, out: Path, run: bool = True) -> str:
    """The tutorial as a page of Markdown; its pictures are put into the folder `out`.

    Args:
        script: the tutorial.
        out: folder of the page.
        run: whether its cells are run, in a folder of their own; without, nothing is printed.
    """
    parts, space = [], {"__name__": script.stem}
    script, out = script.absolute(), out.absolute()  # the cells run in another folder
    with TemporaryDirectory() as work, chdir(work):
        for cell in cells(script):
            if cell.kind == "markdown":
                parts.append(cell.text)
                continue
            parts.append(f"```python\n{cell.text}\n```")
            if run:
                printed = _run(script, cell, space)
                parts += [f"```text\n{printed}\n```"] if printed else []
                parts += [f"![{name}]({name})" for name in _pictures(Path(work), out, script.stem)]
    return "\n\n".join(parts) + "\n"


def notebook(script: Path) -> str:
    """The tutorial as a notebook that has not been run yet (nbformat 4.5)."""
    entries: list[dict[str, Any]] = []
    for number, cell in enumerate(cells(script)):
        entry = {"id": f"cell-{number}", "cell_type": cell.kind, "metadata": {}}
        code = {"execution_count": None, "outputs": []} if cell.kind == "code" else {}
        entries.append({**entry, **code, "source": cell.text.splitlines(keepends=True)})
    about = {"language_info": {"name": "python"}}
    whole = {"nbformat": 4, "nbformat_minor": 5, "metadata": about, "cells": entries}
    return json.dumps(whole, indent=1) + "\n"


def _run(script: Path, cell: Cell, space: dict[str, Any]) -> str:
    """What a cell prints; an error tells the script's own line."""
    printed = io.StringIO()
    with redirect_stdout(printed):
        exec(compile("\n" * cell.line + cell.text, str(script), "exec"), space)  # noqa: S102
    return printed.getvalue().rstrip()


def _pictures(work: Path, out: Path, tutorial: str) -> list[str]:
    """Move a cell's pictures into the page's folder; returns their names there."""
    names = []
    for file in sorted(work.glob("*.png"), key=lambda file: file.stat().st_mtime_ns):
        names.append(f"{tutorial}_{file.name}")
        (out / names[-1]).write_bytes(file.read_bytes())
        file.unlink()
    return names


if __name__ == "__main__":
    script, folder = map(Path, sys.argv[1:])
    folder.mkdir(parents=True, exist_ok=True)
    (folder / f"{script.stem}.md").write_text(page(script, folder), encoding="utf-8")
    (folder / f"{script.stem}.ipynb").write_text(notebook(script), encoding="utf-8")
