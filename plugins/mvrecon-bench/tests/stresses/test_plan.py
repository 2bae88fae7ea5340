"""The stress plan holds for every built-in part and every shipped plugin; and it fails where it
should.
"""

import pytest
import torch

from mvrecon.core.parts import REGISTRIES
from mvrecon_bench.stresses import plan
from mvrecon_bench.stresses.subject import subject_of
from mvrecon_bench.stresses.verdict import FAIL, judge

#: Other libraries' projectors keep their own promises, not ours.
OURS = ("mvrecon.", "mvrecon_spect.")
#: Whose cases are done in float64, too: each kernel, a solver and a network. All else is made of
#: these, and has in float64 those cases that are not for float32.
TWICE = {"drr", "spect", "sirt", "cross_view"}
#: Left out: these are the kernels of "drr" with parallel rays, which tests/operators tries, too.
SAME = {"radon method=siddon", "radon method=trilinear"}
#: Compiled here: a graph contains the method and the rays of ours as constants, whichever they are;
#: tests/kernels compiles every method.
COMPILED = {"drr method=joseph", "spect"}


def rows():
    for kind, name, options in plan.every_part():
        if kind == "mvrecon" or REGISTRIES[kind].origin(name).startswith(OURS):
            for dtype in (torch.float64, torch.float32):
                subject = subject_of(kind, name, options, "cpu", dtype)
                for case, _ in plan.jobs([subject] if subject.label not in SAME else []):
                    if case.name.startswith("torch.compile") and subject.label not in COMPILED:
                        continue
                    once = dtype != torch.float32 and torch.float32 in case.dtypes
                    if not once or name in TWICE:
                        yield pytest.param(
                            case, subject, id=f"{case.number}-{case.name}-{subject.label}-{dtype}"
                        )


@pytest.mark.parametrize(("case", "subject"), list(rows()))
def test_the_plan_holds(case, subject):
    row = judge(case, subject)
    assert row["verdict"] != FAIL, (
        f"{case.holds}: {row['measured']} > {row['tolerance']} {row['note']}"
    )
