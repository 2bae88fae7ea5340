"""Every name of `mv.` has an example in its docstring, which prints what it shows."""

import inspect
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

import mvrecon as mv

NAMES = sorted(set(dir(mv)) - {"__version__"})
#: Takes seconds; `tests/training/test_program.py` runs it.
SLOW = "save_program"


@pytest.mark.parametrize("name", [name for name in NAMES if name != SLOW])
def test_the_example_of_a_name_runs(
    name: str, run_example: Callable[[Any], dict[str, Any]], tmp_path: Path, monkeypatch
):
    monkeypatch.chdir(tmp_path)  # where it writes
    run_example(getattr(mv, name))


@pytest.mark.parametrize("name", NAMES)
def test_a_function_tells_what_it_returns(name: str):
    value = getattr(mv, name)
    returns = not inspect.isclass(value) and value.__annotations__["return"] is not None
    assert ("\nReturns:\n    " in (inspect.getdoc(value) or "")) == returns


def test_a_wrong_example_fails(run_example: Callable[[Any], dict[str, Any]]):
    def wrong() -> None:
        """
        >>> len(mv.Grid.centred(4, spacing=1.0).shape)
        4
        """

    with pytest.raises(AssertionError, match=r"Expected:\n +4\nGot:\n +3"):
        run_example(wrong)
