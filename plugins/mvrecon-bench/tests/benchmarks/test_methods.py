"""`bench=methods`: a slice beside the volume that it is of, and times of long runs."""

import pytest

from mvrecon.data.scenes.solids import voxelise
from mvrecon_bench.benchmarks.cases import Workload
from mvrecon_bench.benchmarks.methods import Methods, measurement_of, shortened

BASE = {"camera": "parallel", "n": 32, "slices": 1, "views": 24, "device": "cpu"}


def test_slice_and_volume_show_the_same_object_and_its_integrals():
    case = Workload(**BASE)
    data = measurement_of(case, 2)
    middle = voxelise(case.phantom(), Workload(n=32).grid())[15:17].mean(dim=0)
    assert data.volume.shape == (1, 32, 32) and data.views.shape == (1, 1, 24, 1, 32)
    assert (data.volume[0] - middle).norm() < 0.2 * middle.norm()
    views = data.A(data.volume[None, None])
    assert (views - data.views).norm() < 0.05 * data.views.norm()


def test_a_long_run_is_extrapolated_from_setup_and_iterations():
    runs: list[int] = []

    def run(count: int) -> float:
        runs.append(count)
        return 3.0 + 2.0 * count

    long = shortened(run, 50, limit_s=100.0)
    assert long is not None and long.seconds == pytest.approx(103.0) and long.iterations == 2
    assert shortened(run, 50, limit_s=104.0) is None  # 250 s, if every iteration cost as the first
    assert shortened(run, 20, limit_s=100.0) is None
    assert runs == [1, 2, 1, 2, 1]
    alone = shortened(run, 50, limit_s=4.0)
    assert alone is not None and alone.iterations == 1


def test_a_method_beyond_the_limit_has_an_extrapolated_time_and_no_error():
    parts = [{"name": "fbp", "peer": "sirt"}, {"name": "sirt", "iterations": 500}]
    bench = Methods(parts, BASE, {"one": {}}, rays=1, repeats=1, limit_s=1e-3)
    rows = {}
    for group in bench.groups():
        rows |= {row["part"]: row for row in bench.measure(group, [], lambda text: None)}
    assert rows["sirt"]["iterations_timed"] in (1, 2) and "error" not in rows["sirt"]
    assert rows["sirt"]["ms"] > 1.0 and rows["fbp"]["over_peer"] < 1
    assert "iterations_timed" not in rows["fbp"] and 0 < rows["fbp"]["error"] < 0.5
    assert set(rows["sirt"]) <= set(bench.columns)
