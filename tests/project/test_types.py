"""Pyrefly finds no error in the package, its plugins and its scripts."""

import json
import sys


def test_the_types_hold(run_python):
    done = run_python(
        *("-m", "pyrefly", "check", "--output-format", "json"),
        *("--python-interpreter-path", sys.executable),
    )
    errors = [
        f"{e['path']}:{e['line']}: {e['description']}" for e in json.loads(done.stdout)["errors"]
    ]
    assert not errors, "\n".join(errors)
    assert done.returncode == 0, done.stderr
