"""How random the properties are: the same examples in every run, or those of a seed that is
printed.

`HYPOTHESIS_PROFILE=thorough` takes twenty times as many. `--hypothesis-seed=<number>`, or `random`,
draws new ones with either profile; a failure also prints the blob with which `@reproduce_failure`
repeats it. Hypothesis draws some numbers from the source of whatever is loaded, too, so a seed
stands for its examples as long as no number in mvrecon changes and no plugin is loaded beside it.
"""

import importlib
import os
import pkgutil
import random

import hypothesis
import pytest
from hypothesis import HealthCheck, settings

import mvrecon

EXAMPLES = 15
SLOW = [HealthCheck.too_slow, HealthCheck.data_too_large]
COMMON = {
    "deadline": None,
    "print_blob": True,
    "derandomize": True,
    "database": None,
    "suppress_health_check": SLOW,
}
settings.register_profile("quick", max_examples=EXAMPLES, **COMMON)
settings.register_profile("thorough", max_examples=20 * EXAMPLES, **COMMON)
# a property takes the profile of the moment that it is defined in, which comes next
settings.load_profile(os.environ.get("HYPOTHESIS_PROFILE", "quick"))
DRAWN = random.SystemRandom().getrandbits(32)


@pytest.fixture(autouse=True, scope="session")
def every_module_is_loaded():
    """So that a test draws the same numbers alone, in its file and among all."""
    for module in pkgutil.walk_packages(mvrecon.__path__, "mvrecon."):
        importlib.import_module(module.name)


def _seed(config) -> int | None:
    asked = config.getoption("--hypothesis-seed")
    return DRAWN if asked == "random" else None if asked is None else int(asked)


def pytest_collection_modifyitems(config, items) -> None:
    """A seed goes before `derandomize` where a test has it by itself."""
    number = _seed(config)
    for item in items:
        if number is not None and getattr(getattr(item, "obj", None), "is_hypothesis_test", False):
            hypothesis.seed(number)(item.obj)


def pytest_terminal_summary(terminalreporter, config) -> None:
    if (number := _seed(config)) is not None:
        terminalreporter.write_line(
            f"The properties' examples are those of --hypothesis-seed={number}"
        )
