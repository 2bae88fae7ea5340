"""A row of the benchmark has the error of that very operator beside its time."""

from mvrecon.core.parts import PROJECTORS
from mvrecon.operators.drr import Drr
from mvrecon_bench.benchmarks.operators import Operators

BASE = {"n": 8, "views": 2, "device": "cpu", "threads": 1, "scene": "box"}


class Scaled(Drr):
    """A projector that is fast, and wrong by five percent."""

    def forward(self, volume):
        return 1.05 * super().forward(volume)


def test_a_five_percent_error_is_reported_beside_the_time(monkeypatch):
    monkeypatch.setitem(PROJECTORS._parts, "scaled", Scaled)
    parts = [{"name": "drr", "method": "siddon"}, {"name": "scaled", "method": "siddon"}]
    bench = Operators(parts, BASE, {"sizes": {"about": {}, "vary": {"n": [8]}}}, rays=2, repeats=1)
    rows = [row for jobs in bench.groups() for row in bench.measure(jobs, lambda text: None)]
    assert [row["part"] for row in rows] == ["drr", "scaled"]
    assert all({"error_thin", "forward_ms"} <= set(row) for row in rows)
    assert abs(rows[1]["error_thin"] - rows[0]["error_thin"]) > 0.01
