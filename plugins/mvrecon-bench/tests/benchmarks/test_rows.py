"""The table outlives crashes."""

import math
from typing import ClassVar

import pytest

from mvrecon_bench import runner
from mvrecon_bench.rows import Bench, Rows, cell, value

COLUMNS, KEYS = ["part", "n", "ratio", "ms", "repeatable"], ["part", "n", "ratio"]


def test_rows_survive_a_crash_during_a_write(tmp_path):
    path = tmp_path / "results.csv"
    table = Rows(path, COLUMNS, KEYS)
    kept = table.append(
        {"part": 'a "quoted", one', "n": 32, "ratio": 0.5, "ms": 1.25, "repeatable": True}
    )
    table.append({"part": "b", "n": 32, "ratio": 1.0})
    path.write_text(path.read_text() + "c,32,1")
    again = Rows(path, COLUMNS, KEYS)
    assert again.rows == table.rows and again.rows[0] == kept
    assert {"part": "b", "n": 32, "ratio": 1} in again and {
        "part": "c",
        "n": 32,
        "ratio": 1,
    } not in again
    again.append({"part": "c", "n": 32, "ratio": 1.0})
    assert len(Rows(path, COLUMNS, KEYS).rows) == 3


def test_a_table_with_other_columns_is_refused_unchanged(tmp_path):
    path = tmp_path / "results.csv"
    Rows(path, COLUMNS, KEYS)
    before = path.read_text()
    with pytest.raises(ValueError, match="give another folder"):
        Rows(path, [*COLUMNS, "more"], KEYS)
    with pytest.raises(KeyError, match="no column more"):
        Rows(path, COLUMNS, KEYS).append({"more": 1})
    assert path.read_text() == before


def test_cells_round_trip():
    assert cell(None) == "" and cell(True) == "yes" and cell("two\nlines") == "two lines"
    assert (
        value(cell(0.125)) == 0.125
        and math.isnan(value(cell(math.nan)))
        and value("1e3x") == "1e3x"
    )


class Empty(Bench):
    """A benchmark without rows."""

    columns: ClassVar = {"status": "ok"}
    keys: ClassVar = ("status",)
    charts, title, shown = (), "Nothing", {}

    def groups(self):
        return ()

    def label(self, row):
        return ""

    def measure(self, jobs, say):
        yield from ()


def test_a_benchmark_that_is_stopped_before_its_first_row_resumes(tmp_path, monkeypatch):
    """It refused its own folder as another run's, which has settings and no table."""

    def stop():
        raise KeyboardInterrupt

    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(runner, "machine", stop)
        runner.run(Empty(), tmp_path, {"bench": {}})
    assert runner.run(Empty(), tmp_path, {"bench": {}}) == []
