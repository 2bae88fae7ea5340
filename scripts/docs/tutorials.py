"""Tutorials as pages and notebooks: python scripts/docs/tutorials.py SCRIPT OUT_FOLDER

A tutorial is a script in docs/tutorials whose cells begin with `# %%`, of text with
`# %% [markdown]`, as editors, jupytext and this file read them. The page shows each cell with what
it printed and the pictures that it saved.
"""

import io
import json
import re
import sys
from base64 import b64encode
from collections.abc import Iterable, Iterator, Mapping
from contextlib import chdir, redirect_stdout
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple


class Cell(NamedTuple):
    """One cell of a tutorial: Markdown or Python, its text, the line it begins at; of a cell that
    has run what it printed, and its pictures by name.
    """

    kind: str
    text: str
    line: int
    printed: str = ""
    pictures: Mapping[str, bytes] = {}


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


def executed(script: Path) -> Iterator[Cell]:
    """The cells of a script, run in a folder of their own."""
    script = script.absolute()  # the cells run in another folder
    space: dict[str, Any] = {"__name__": script.stem}
    with TemporaryDirectory() as work, chdir(work):
        for cell in cells(script):
            if cell.kind == "code":
                printed = _run(script, cell, space)
                drawn = sorted(Path().glob("*.png"), key=lambda file: file.stat().st_mtime_ns)
                pictures = {f"{script.stem}_{file.name}": file.read_bytes() for file in drawn}
                cell = cell._replace(printed=printed, pictures=pictures)  # noqa: PLW2901
                for file in drawn:
                    file.unlink()
            yield cell


def page(tutorial: Iterable[Cell]) -> str:
    """A tutorial as a page of Markdown, beside which its pictures lie."""
    parts = []
    for cell in tutorial:
        parts.append(f"```python\n{cell.text}\n```" if cell.kind == "code" else cell.text)
        parts += [f"```text\n{cell.printed}\n```"] if cell.printed else []
        parts += [f"![{name}]({name})" for name in cell.pictures]
    return "\n\n".join(parts) + "\n"


def notebook(tutorial: Iterable[Cell]) -> str:
    """A tutorial as a notebook with what its cells printed and drew (nbformat 4.5)."""
    entries: list[dict[str, Any]] = []
    for number, cell in enumerate(tutorial):
        source = cell.text.splitlines(keepends=True)
        entry: dict[str, Any] = {"id": f"cell-{number}", "cell_type": cell.kind, "source": source}
        entry["metadata"] = {}
        if cell.kind == "code":
            lines = cell.printed.splitlines(keepends=True)
            printed = {"output_type": "stream", "name": "stdout", "text": lines}
            images = [{"image/png": b64encode(image).decode()} for image in cell.pictures.values()]
            drawn = [{"output_type": "display_data", "data": i, "metadata": {}} for i in images]
            entry |= {"execution_count": None, "outputs": [printed] * bool(lines) + drawn}
        entries.append(entry)
    about = {"language_info": {"name": "python"}}
    whole = {"nbformat": 4, "nbformat_minor": 5, "metadata": about, "cells": entries}
    return json.dumps(whole, indent=1) + "\n"


def write(script: Path, folder: Path, run: bool = True) -> None:
    """Write a tutorial's page, pictures and notebook into a folder.

    Args:
        script: the tutorial.
        folder: created if missing.
        run: whether its cells are run; without, nothing is printed or drawn.
    """
    tutorial = list(executed(script) if run else cells(script))
    folder.mkdir(parents=True, exist_ok=True)
    text = f"{page(tutorial)}\n[As a notebook]({script.stem}.ipynb)\n"
    (folder / f"{script.stem}.md").write_text(text, encoding="utf-8")
    (folder / f"{script.stem}.ipynb").write_text(notebook(tutorial), encoding="utf-8")
    for cell in tutorial:
        for name, image in cell.pictures.items():
            (folder / name).write_bytes(image)


def _run(script: Path, cell: Cell, space: dict[str, Any]) -> str:
    """What a cell prints; an error tells the script's own line."""
    printed = io.StringIO()
    with redirect_stdout(printed):
        exec(compile("\n" * cell.line + cell.text, str(script), "exec"), space)  # noqa: S102
    return printed.getvalue().rstrip()


if __name__ == "__main__":
    write(Path(sys.argv[1]), Path(sys.argv[2]))
