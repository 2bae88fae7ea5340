"""A hanging case: reported as a failure, or the process exits with a traceback if no Python code
runs.
"""

import os

import pytest

from mvrecon_bench.stresses.fresh_process import python

HANGING = """
import signal, sys, time
from mvrecon_bench.stresses.case import Case
from mvrecon_bench.stresses.subject import Subject
from mvrecon_bench.stresses.verdict import judge, watched

def hang(subject):
    while True:
        pass

row = judge(Case(77, "x", "y", "mvrecon", hang), Subject("mvrecon"), 0.2)
sys.stdout.write(f"{row['verdict']} {row['note']}\\n")
sys.stdout.flush()
# as compiled code, which no signal reaches
signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGALRM})
with watched(0.2, 0.3):
    time.sleep(60)
"""


@pytest.mark.skipif(os.name != "posix", reason="an alarm interrupts Python on POSIX systems alone")
def test_a_hanging_case_fails_and_one_in_compiled_code_ends_the_app_with_a_traceback():
    done = python("-c", HANGING)
    assert "FAIL TimeoutError: still at work after 0.2 s" in done.stdout, done.stderr
    assert done.returncode == 1
    assert "Timeout" in done.stderr and "most recent call first" in done.stderr
