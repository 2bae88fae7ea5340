"""The models of emission are measured in one run, each over the plain one."""

import pytest

from mvrecon_bench.benchmarks import emission, runner


def test_ratios_are_computed_from_seconds(tmp_path):
    bench = emission.Emission(n=8, spacing=20.0, pixels=8, rays=[1, 2], repeats=1)
    rows = runner.run(bench, tmp_path)
    key = ("model", "method", "rays_per_pixel")
    seconds = {tuple(row[name] for name in key): row["cpu_s"] for row in rows}
    assert {model for model, *_ in seconds} == {"plain", "attenuated", "blur", "both"}
    assert {(method, rays) for _, method, rays in seconds} == {
        ("joseph", 1),
        ("joseph", 2),
        ("distance_driven", 1),
    }
    for row in rows:
        if row["model"] == "plain":
            assert row["over_plain"] == row["over_one_ray"]
        if row["method"] != "joseph":  # measured with other seconds of one ray
            continue
        own, one = row["cpu_s"], seconds[row["model"], "joseph", 1.0]
        plain = seconds["plain", "joseph", 1.0]
        assert row["over_plain"] == pytest.approx(own / plain, rel=1e-4)
        assert row["over_one_ray"] == pytest.approx(own / one, rel=1e-4)
    assert runner.run(bench, tmp_path) == rows  # nothing is measured twice
