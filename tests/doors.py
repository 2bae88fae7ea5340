"""Runs every test with the marker `door` and says how it went: `python -m tests.doors [folder]`.

The last line is JSON: a test's fact (first paragraph of its docstring), and how many of its cases
pass, fail and are left out.
"""

import inspect
import json
import sys

import pytest

from mvrecon_bench.stresses.verdict import FAIL, LEFT_OUT, PASS


def fact(item: pytest.Item) -> str:
    """The first paragraph of a test's docstring; without one, its name."""
    text = inspect.getdoc(getattr(item, "obj", None)) or item.name
    return " ".join(text.partition("\n\n")[0].split())


class Verdicts:
    """A plugin of pytest that counts the verdicts on each fact."""

    def __init__(self) -> None:
        self.counts: dict[str, dict[str, int]] = {}
        self._facts: dict[str, str] = {}

    def pytest_collection_finish(self, session: pytest.Session) -> None:
        """All tests that were chosen are known."""
        self._facts = {item.nodeid: fact(item) for item in session.items}
        self.counts = {
            text: dict.fromkeys((PASS, FAIL, LEFT_OUT), 0) for text in self._facts.values()
        }

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        """A test's set-up, call or end is over; of one that goes well only the call counts."""
        verdict = {"passed": PASS, "failed": FAIL, "skipped": LEFT_OUT}[report.outcome]
        if verdict != PASS or report.when == "call":
            self.counts[self._facts[report.nodeid]][verdict] += 1


def main(*folders: str) -> None:
    """Entry point."""
    verdicts = Verdicts()
    pytest.main(["-q", "-m", "door", "-p", "no:cacheprovider", *folders], plugins=[verdicts])
    sys.stdout.write("\n" + json.dumps(verdicts.counts) + "\n")


if __name__ == "__main__":
    main(*sys.argv[1:])
