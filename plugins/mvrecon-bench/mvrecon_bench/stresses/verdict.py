"""The verdict on a case and a part: measured figure against tolerance."""

import math
import time
import warnings

import torch

from mvrecon_bench.benchmarks.rows import Row
from mvrecon_bench.benchmarks.trial import reason
from mvrecon_bench.stresses.case import Case, DoesNotApply
from mvrecon_bench.stresses.subject import Subject
from mvrecon_bench.stresses.watchdog import LIMIT, watched

PASS, FAIL, LEFT_OUT = "pass", "FAIL", "n/a"
#: Columns of a table of verdicts, and their meaning.
COLUMNS = {
    "number": "of the case in the plan",
    "part": "the tested part, with its options",
    "case": "name of the case",
    "holds": "the property; `measured` is the deviation from it",
    "measured": "worst error or count of violations",
    "tolerance": "largest permitted value; 0: bitwise equal, or no violation",
    "verdict": f"{PASS}, {FAIL}, or {LEFT_OUT} where the case does not apply to the part",
    "note": "reason for a failure or for not applying",
    "device": "of the test",
    "dtype": "of volumes and views",
    "seconds": "run time",
}


def judge(case: Case, subject: Subject, limit_s: float = LIMIT) -> Row:
    """Run a case on a subject. An exception of the part is caught and becomes the note of a
    failure.

    A case that exceeds `limit_s` also fails; if it hangs in compiled code, the process exits, see
    `watched`.
    """
    start, measured, note = time.perf_counter(), math.nan, ""
    allowed = case.allowed(subject.dtype)
    try:
        with watched(limit_s), warnings.catch_warnings(), torch.random.fork_rng(devices=[]):
            warnings.simplefilter("ignore")
            measured = float(case.measure(subject))
        verdict = PASS if measured <= allowed else FAIL  # NaN does not pass
    except DoesNotApply as why:
        verdict, note = LEFT_OUT, str(why)
    except (
        Exception,
        SystemExit,
    ) as error:  # plugins may raise anything; it must not end the plan
        verdict, note = FAIL, reason(error)
    return {
        **identity(case, subject),
        "holds": case.holds,
        "measured": measured,
        "tolerance": allowed,
        "verdict": verdict,
        "note": note,
        "seconds": round(time.perf_counter() - start, 3),
    }


def identity(case: Case, subject: Subject) -> Row:
    """The columns that identify a row."""
    return {
        "number": case.number,
        "part": subject.label,
        "case": case.name,
        "device": subject.device,
        "dtype": str(subject.dtype).removeprefix("torch."),
    }
