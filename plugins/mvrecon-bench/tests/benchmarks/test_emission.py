"""The models of emission are measured in one run, each over the plain one."""

import pytest

from mvrecon_bench import runner
from mvrecon_bench.benchmarks import emission


def test_ratios_are_computed_from_seconds(tmp_path):
    bench = emission.Emission(n=8, spacing=40.0, pixels=8, repeats=1)
    rows = runner.run(bench, tmp_path)
    seconds = {(row["model"], row["method"]): row["cpu_s"] for row in rows}
    models = {"plain", "attenuated", "blur", "both"}
    assert set(seconds) == {*((model, "footprints") for model in models), ("plain", "joseph")}
    for (model, method), own in seconds.items():
        row = next(row for row in rows if (row["model"], row["method"]) == (model, method))
        plain = seconds["plain", "footprints"]
        assert row["over_plain"] == pytest.approx(own / plain, rel=1e-4)
    assert runner.run(bench, tmp_path) == rows  # nothing is measured twice
