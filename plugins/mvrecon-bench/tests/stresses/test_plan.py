"""The stress plan holds for every built-in part and every shipped plugin; and it fails where it
should.
"""

import pytest
import torch

from mvrecon.core.parts import REGISTRIES
from mvrecon_bench.stresses import plan
from mvrecon_bench.stresses.subject import subject_of
from mvrecon_bench.stresses.verdict import FAIL, judge
from tests.covering import takes_long

#: Other libraries' projectors keep their own promises, not ours.
OURS = ("mvrecon.", "mvrecon_spect.")
#: Run through every case; the others take turns, and all have all of them with `-m long`.
WHOLE = {"drr method=joseph", "sirt", "cross_view", "circular", "ellipsoids", "mvrecon"}
#: Of so many cases a part that is not whole runs through one.
TURNS, TURNS_OF_SPECT = 6, 2
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
    """Each case on every sixth part in turn, in a dtype in turn; on `WHOLE` parts; and every other
    one on the pinholes.
    """
    if "case" not in metafunc.fixturenames:
        return
    rows = []
    for i, (kind, name, options) in enumerate(parts()):
        subjects = [subject_of(kind, name, options, "cpu", dtype) for dtype in DTYPES]
        turns = TURNS_OF_SPECT if name == "spect" else TURNS
        for j, case in enumerate(plan.cases()):
            own = [each for each in subjects if each.dtype in case.dtypes and case.kind == kind]
            if case.name.startswith("torch.compile") and subjects[0].label not in COMPILED:
                continue
            for k, subject in enumerate(own):
                turn = (i + j) // turns % len(own) == k
                few = turn and (subject.label in WHOLE or (i + j) % turns == 0)
                if few or takes_long(metafunc.config):
                    row = f"{case.number}-{case.name}-{subject.label}-{subject.dtype}"
                    marks = () if few else pytest.mark.long
                    rows.append(pytest.param(case, subject, id=row, marks=marks))
    metafunc.parametrize(("case", "subject"), rows)


def test_the_plan_holds(case, subject):
    row = judge(case, subject)
    assert row["verdict"] != FAIL, (
        f"{case.holds}: {row['measured']} > {row['tolerance']} {row['note']}"
    )
