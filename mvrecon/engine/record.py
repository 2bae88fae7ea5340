"""What a run folder tells: settings, versions and results, each file written whole or not at
all.
"""

import json
import math
import platform
import sys
from importlib import metadata
from pathlib import Path
from typing import Any

import yaml

from mvrecon import __version__
from mvrecon.engine.old_names import current
from mvrecon.files.atomic import written_whole
from mvrecon.files.checks import yaml_of

PACKAGES = ("lightning", "torchmetrics", "kornia", "numba", "numpy", "h5py", "hydra-core")
SETTINGS, EVALUATION, VERSIONS, RESULTS = "config.yaml", "eval.yaml", "versions.txt", "results.json"


def versions() -> dict[str, str]:
    """Versions of Python, of mvrecon and of what its numbers depend on.

    Torch's is its own, which tells the build (2.13.0+cu130) that the package index leaves out
    (2.13.0).
    """
    import torch

    known = {
        "mvrecon": __version__,
        "python": platform.python_version(),
        "platform": platform.platform(),
    }
    known["torch"] = str(torch.__version__)
    for name in PACKAGES:
        try:
            known[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            known[name] = "not installed"
    return known


def start(folder: Path, settings: dict[str, Any], file: str = SETTINGS) -> None:
    """Write down a run's settings, plain and resolved, and the versions it runs with."""
    write(folder / file, yaml.safe_dump(settings, sort_keys=False))
    write(folder / VERSIONS, "".join(f"{name} {version}\n" for name, version in versions().items()))


def read_settings(folder: Path) -> dict[str, Any]:
    """The settings that a run was started with, by the option names of this version.

    Raises:
        FileNotFoundError: the folder is no run folder.
    """
    path = folder / SETTINGS
    if not path.is_file():
        raise FileNotFoundError(f"Expected a run folder with {SETTINGS} in it, got {folder}")
    return current(yaml_of(path))


def anchored(value: Any) -> Any:
    """Settings with every `path` in them made absolute, so that they mean the same from any other
    folder.
    """
    if isinstance(value, dict):
        return {
            key: _absolute(item) if key == "path" else anchored(item) for key, item in value.items()
        }
    return [anchored(item) for item in value] if isinstance(value, list) else value


def write_results(folder: Path, results: dict[str, Any]) -> None:
    """Write `results.json` with the command and the versions; figures that are not finite become
    null.
    """
    whole = {**results, "command": sys.argv, "versions": versions()}
    write(folder / RESULTS, json.dumps(_finite(whole), indent=2, allow_nan=False) + "\n")


def write(path: Path, text: str) -> None:
    """Write a text file; one of that name is replaced whole or not at all."""
    with written_whole(path) as part:
        part.write_text(text, encoding="utf-8")


def _absolute(path: Any) -> Any:
    return str(Path(path).expanduser().absolute()) if isinstance(path, str) else path


def _finite(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _finite(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
