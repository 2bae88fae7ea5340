"""The stress plan holds for every built-in part and every shipped plugin; and it fails where it
should.
"""

import math

import pytest
import torch

from mvrecon.core.parts import REGISTRIES
from mvrecon_bench.stresses import case as cases, plan
from mvrecon_bench.stresses.subjects import subject_of
from mvrecon_bench.stresses.verdict import FAIL, judge
from tests.covering import takes_long

#: Other libraries' projectors keep their own promises, not ours.
OURS = ("mvrecon.", "mvrecon_spect.")
DTYPES = (torch.float32, torch.float64)
#: Left out: these are the kernels of "drr" with parallel rays, which tests/operators tries, too.
SAME = {"radon method=siddon", "radon method=trilinear"}
#: Compiled here: a graph contains the method and the rays of ours as constants, whichever they are;
#: tests/kernels compiles every method.
COMPILED = {"drr method=joseph", "spect"}


def parts() -> list[tuple]:
    """Kind, name and options of our parts."""
    return [
        (kind, name, options)
        for kind, name, options in plan.every_part()
        if (kind == "mvrecon" or REGISTRIES[kind].origin(name).startswith(OURS))
        and subject_of(kind, name, options).label not in SAME
    ]


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    """Each case on one part and in one dtype, in turn, and on the pinholes every third; all pairs
    with `-m long`.
    """
    if "case" not in metafunc.fixturenames:
        return
    every, rows = parts(), []
    for j, case in enumerate(plan.cases()):
        own = [part for part in every if part[0] == case.kind]
        if case.name.startswith("torch.compile"):
            own = [part for part in own if subject_of(*part).label in COMPILED]
        for i, part in enumerate(own):
            for k, dtype in enumerate(dtype for dtype in DTYPES if dtype in case.dtypes):
                subject = subject_of(*part, "cpu", dtype)
                few = (j - k) % min(2, len(case.dtypes)) == 0 and (j // 2 - i) % len(own) == 0
                few |= subject.name == "spect" and j % 3 == 0 and k == 0
                if few or takes_long(metafunc.config):
                    row = f"{case.number}-{case.name}-{subject.label}-{dtype}"
                    marks = () if few else pytest.mark.long
                    rows.append(pytest.param(case, subject, id=row, marks=marks))
    metafunc.parametrize(("case", "subject"), rows)


def test_the_plan_holds(case, subject):
    row = judge(case, subject)
    assert row["verdict"] != FAIL, (
        f"{case.holds}: {row['measured']} > {row['tolerance']} {row['note']}"
    )


@pytest.mark.parametrize(
    ("tolerance", "numbers", "measured"),
    [
        (0.5, (0.1, 0.3, 0.2), 0.3),
        (cases.EXACT, (-1.0, -2.0), -1.0),
        (0.0, (1, True, 2.0), 4.0),
        (0.0, (), 0.0),
        (0.5, (0.1, math.nan, 0.2), math.nan),
        (0.0, (0, math.nan), math.nan),
    ],
)
def test_a_case_measures_its_greatest_error_or_all_of_its_violations(tolerance, numbers, measured):
    @cases.case("mvrecon", 1, tolerance)
    def some(_):
        """Numbers: none is too large."""
        yield from numbers

    assert some.case.measure(None) == pytest.approx(measured, nan_ok=True)
