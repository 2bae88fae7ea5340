"""The table outlives crashes, and targets are computed from it."""

import math

import pytest

from mvrecon_bench.benchmarks import targets
from mvrecon_bench.benchmarks.rows import Rows, cell, value

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


def row(part, method="", **figures):
    options = f'{{"method": "{method}"}}' if method else ""
    case = {"n": 128.0, "dtype": "float32", "rays": 2.0**20}
    return {
        "part": part,
        "method": method,
        "options": options,
        "backend": "cpu",
        "status": "ok",
        **case,
        **figures,
    }


def test_targets_are_met_missed_or_not_measured():
    rows = [
        row(
            "drr",
            "joseph",
            forward_ms=30.0,
            adjoint_ms=90.0,
            pose_grad_ms=120.0,
            peak_mb=4.5,
            adjointness=1e-7,
        ),
        row("drr", "joseph", forward_ms=300.0, n=256.0, adjointness=1e-7),
        {
            **row("drr", "joseph", forward_ms=1.0),
            "options": '{"method": "joseph", "rays_per_pixel": 2}',
        },
        row("rtk", forward_ms=100.0, adjoint_ms=100.0),
        {**row("nanodrr"), "status": "skipped: ImportError: not there"},
    ]
    base = {"n": 128, "dtype": "float32"}
    text = targets.table((*targets.CPU, *targets.ACCURACY), rows, base)
    verdicts = {
        line.split(" | ")[0].strip("| "): line.strip(" |").split(" | ")[1:]
        for line in text.splitlines()[2:]
    }
    assert verdicts["joseph forward / RTK's"] == ["0.3", "0.333", "0.2", "met"]
    assert verdicts["joseph adjoint / RTK's"][0::3] == ["0.9", "missed"]
    assert verdicts["joseph adjoint / forward"][-1] == "missed"
    assert (
        verdicts["joseph geometry VJP / forward"][0] == "3"
        and verdicts["joseph geometry VJP / forward"][-1] == "met"
    )
    assert verdicts["joseph forward, 256^3 / 128^3"][0] == "10"
    assert verdicts["joseph forward / nanodrr's"][-1] == "not measured"
    assert verdicts["adjointness, float32, worst"][-1] == "met"
    assert verdicts["adjointness, float64, worst"][-1] == "not measured"
    assert verdicts["memory beyond input and output, MB, worst"][0] == "0.5"
