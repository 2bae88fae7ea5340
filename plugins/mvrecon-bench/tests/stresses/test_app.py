"""`mvrecon-stress` as a user calls it."""

import csv
import sys
from importlib import import_module

import pytest

import mvrecon_bench.stress
from mvrecon_bench.benchmarks.cases import Workload
from mvrecon_bench.stresses import plan
from mvrecon_bench.stresses.case import Case


def call(folder, monkeypatch) -> list[dict[str, str]]:
    options = ("parts=[mvrecon]", "cases=[6]", "hydra/job_logging=none")
    monkeypatch.setattr(sys, "argv", ["mvrecon-stress", f"out={folder}", *options])
    try:
        mvrecon_bench.stress.main()
    finally:
        with open(folder / "results.csv", newline="") as file:
            rows = list(csv.DictReader(file))
    return rows


def test_verdicts_are_counted_and_stored(tmp_path, monkeypatch, capsys):
    rows = call(tmp_path, monkeypatch)
    assert {row["dtype"] for row in rows} == {"float64", "float32"}
    assert {(row["number"], row["verdict"]) for row in rows} == {("6", "pass")}
    assert "2 pass, 0 FAIL, 0 n/a; all is in" in capsys.readouterr().out
    assert "# Stress plan" in (tmp_path / "table.md").read_text()


def test_a_failed_case_is_reported_and_the_app_exits_with_an_error(tmp_path, monkeypatch, capsys):
    bad = Case(6, "a bad case", "nothing", "mvrecon", lambda subject: 3.0)
    monkeypatch.setattr(plan, "cases", lambda: [bad])
    with pytest.raises(SystemExit) as error:
        call(tmp_path, monkeypatch)
    assert error.value.code == 1
    assert "FAIL 6 a bad case, mvrecon float64: 3.0 > 0" in capsys.readouterr().out


def test_an_unknown_device_is_refused_as_in_the_other_apps():
    with pytest.raises(ValueError, match="did you mean 'gpu'"):
        Workload(device="gpus")


@pytest.mark.parametrize("table", [None, "other,columns\n"])
@pytest.mark.parametrize("app", ["bench", "stress"])
def test_the_folder_of_another_run_is_refused_and_stays_as_it_was(
    tmp_path, monkeypatch, table, app
):
    """A training's, whose settings would be overwritten, and a table with other columns."""
    (tmp_path / "config.yaml").write_text("name: trained\n")
    if table:
        (tmp_path / "results.csv").write_text(table)
    before = {path: path.read_bytes() for path in tmp_path.iterdir()}
    main = import_module(f"mvrecon_bench.{app}").main
    monkeypatch.setattr(sys, "argv", [app, f"out={tmp_path}", "hydra/job_logging=none"])
    with pytest.raises(SystemExit):
        main()
    assert {path: path.read_bytes() for path in tmp_path.iterdir()} == before
