"""`mvrecon-bench bench=precision` on sizes that take seconds: each precision errs by what its
digits say.
"""

import math

import pytest

from mvrecon_bench.benchmarks.precision import TRUTH, USUAL
from mvrecon_bench.rows import value

TINY = (
    "bench=precision",
    "bench.base={n: 16, views: 2, device: cpu, threads: 1}",
    "bench.tasks=[joseph forward, siddon adjoint]",
    "bench.repeats=1",
)
#: Half a unit in the last place, twice: of the operand, and of what rounding in float32 adds.
STORED = {"bfloat16 stored": 2**-8, "float16 stored": 2**-11}


@pytest.fixture(scope="module")
def rows(tmp_path_factory, call):
    texts = call(tmp_path_factory.mktemp("bench") / "precision", *TINY)
    return [{name: value(text) for name, text in row.items()} for row in texts]


def of(rows, precision):
    return [row for row in rows if row["precision"] == precision]


def test_each_precision_has_its_rounding_error(rows):
    assert all(row["error"] == 0 for row in of(rows, TRUTH))
    assert all(0 < row["error"] < 1e-5 for row in of(rows, USUAL))
    for precision, most in STORED.items():
        assert all(most / 50 < row["error"] < most for row in of(rows, precision)), precision
    assert len(rows) == 8 and all(row["not_finite"] == 0 for row in rows)
    assert {row["status"] for row in rows} == {"ok"}


def test_times_are_relative_to_float32(rows):
    assert all(row["ratio"] == 1 for row in of(rows, USUAL))
    usual = {row["task"]: row["ms"] for row in of(rows, USUAL)}
    assert all(
        math.isclose(row["ratio"], row["ms"] / usual[row["task"]], rel_tol=1e-4) for row in rows
    )
