"""`bench=methods`: a slice beside the volume that it is of, and times beside a peer's."""

from mvrecon.data.scenes.solids import voxelise
from mvrecon_bench.benchmarks.cases import Workload
from mvrecon_bench.benchmarks.methods import Methods, measurement_of

BASE = {"camera": "parallel", "n": 32, "slices": 1, "views": 24, "device": "cpu"}


def test_slice_and_volume_show_the_same_object_and_its_integrals():
    case = Workload(**BASE)
    data = measurement_of(case, 2)
    middle = voxelise(case.phantom(), Workload(n=32).grid())[15:17].mean(dim=0)
    assert data.volume.shape == (1, 32, 32) and data.views.shape == (1, 1, 24, 1, 32)
    assert (data.volume[0] - middle).norm() < 0.2 * middle.norm()
    views = data.A(data.volume[None, None])
    assert (views - data.views).norm() < 0.05 * data.views.norm()


def test_times_are_relative_to_the_peer():
    parts = [{"name": "fbp", "peer": "sirt"}, {"name": "sirt", "iterations": 500}]
    bench = Methods(parts, BASE, {"one": {}}, rays=1, repeats=1)
    rows = {}
    for group in bench.groups():
        rows |= {row["part"]: row for row in bench.measure(group, lambda text: None)}
    fbp, sirt = rows["fbp"], rows["sirt"]
    assert fbp["over_peer"] == fbp["ms"] / sirt["ms"] < 1
    assert 0 < fbp["error"] < 0.5 and 0 < sirt["error"] < 0.5
    assert set(sirt) <= set(bench.columns)
