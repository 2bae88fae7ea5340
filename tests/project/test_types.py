"""Pyright finds no error in the package, its plugins and its scripts."""

import json


def test_the_types_hold(run_python):
    import sys

    done = run_python(
        "-m", "pyright", "--outputjson", "-p", "pyproject.toml", "--pythonpath", sys.executable
    )
    report = json.loads(done.stdout)
    errors = [
        f"{d['file']}:{d['range']['start']['line'] + 1}: {d['message']}"
        for d in report["generalDiagnostics"]
        if d["severity"] == "error"
    ]
    assert not errors, "\n".join(errors)
    assert report["summary"]["filesAnalyzed"] > 20
