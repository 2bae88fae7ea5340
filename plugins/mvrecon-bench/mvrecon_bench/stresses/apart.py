"""Other processes: what must not run in this one, because it ends it, is ended, or needs another setting."""

import json
import os
import subprocess
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import mvrecon

#: Seconds after which a process counts as hanging.
LIMIT = 100.0


def python(*arguments: str, seconds: float = LIMIT, **options: Any) -> subprocess.CompletedProcess[str]:
    """A Python of its own, with this mvrecon on its path; `options` as of `subprocess.run`, `env` on top of this one's.

    Raises:
        TimeoutExpired: it takes longer than so many seconds; it is ended.
    """
    given: Mapping[str, str] = options.pop("env", {})
    here = str(Path(mvrecon.__file__).parents[1])
    path = os.pathsep.join([here, *filter(None, [os.environ.get("PYTHONPATH")])])
    return subprocess.run(
        [sys.executable, *arguments],
        env={**os.environ, "PYTHONPATH": path, **given},
        **{"capture_output": True, "text": True, "check": False, "timeout": seconds, **options},
    )


def apart(function: Callable[[Path], Any], folder: Path) -> Any:
    """What a function of a module, with a folder as its argument, returns in a process of its own, by way of JSON.

    Raises:
        RuntimeError: it raises, or ends its process.
    """
    code = (
        f"import json, sys; from pathlib import Path; from {function.__module__} import {function.__qualname__} as f; "
        "sys.stdout.write('\\n' + json.dumps(f(Path(sys.argv[1]))))"
    )
    done = python("-c", code, str(folder))
    if done.returncode:
        raise RuntimeError(f"{function.__name__} ended with {done.returncode}: {done.stderr.strip()[-400:]}")
    return json.loads(done.stdout.splitlines()[-1])
