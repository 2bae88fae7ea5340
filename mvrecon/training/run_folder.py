"""The folder of one run: its lock, settings, versions, digests and results; all files are written
atomically.
"""

import json
import math
import platform
import sys
import warnings
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING, Any

import yaml

from mvrecon import __version__
from mvrecon.core import registry
from mvrecon.core.files.atomic import claimed, write_text
from mvrecon.core.files.checks import Refused, file_errors, shown, text_of, yaml_of
from mvrecon.core.files.runs import RESULTS, SETTINGS, VERSIONS, check_inputs
from mvrecon.data import digests
from mvrecon.geometry.cameras import files
from mvrecon.training.settings import TrainSettings

if TYPE_CHECKING:
    from mvrecon.data.module import SceneData  # which takes Lightning

PACKAGES = ("lightning", "torchmetrics", "kornia", "numba", "numpy", "h5py", "hydra-core")
DIGESTS_FILE, RIG = "digests.json", "rig.json"
#: Results of a run; a folder with any of them must have a settings file.
RESULT_NAMES = (SETTINGS, RESULTS, "checkpoints", "cases")


@contextmanager
def run_lock(
    folder: Path, settings: Mapping[str, Any], file: str = SETTINGS, products: Sequence[str] = ()
) -> Iterator[None]:
    """Context that locks a run folder, new or of a run with the same settings, and writes the
    settings. An error before the first result or checkpoint removes them if they are new, so that a
    corrected command may use the folder.

    Args:
        folder: folder of the run.
        settings: plain settings.
        file: name of the settings' file.
        products: files that a failing run removes, if they are new.

    Raises:
        RuntimeError: another process uses the folder.
        ValueError, FileExistsError: it is another run's, see `check`; a file that a new run would
            write is an input in its settings.

    Warns:
        UserWarning: the run began with other versions or other code of its plugins.
    """
    own = (file, VERSIONS)
    if file == SETTINGS:  # an evaluation writes no rig
        own += (DIGESTS_FILE, RIG)
    if not (folder / file).is_file():
        check_inputs(settings, [folder / name for name in (*own, RESULTS, *products)])
    with claimed(folder):
        check(folder, settings, file)
        compare_versions(folder, settings)
        new, started = (
            [folder / name for name in names if not (folder / name).exists()]
            for names in (products, own)
        )
        try:
            start(folder, settings, file)
            yield
        except BaseException as error:
            done = any((folder / name).exists() for name in RESULT_NAMES if name != SETTINGS)
            for path in new if done or not isinstance(error, Exception) else [*new, *started]:
                path.unlink(missing_ok=True)
            raise


def check(folder: Path, settings: Mapping[str, object], file: str = SETTINGS) -> None:
    """Compare settings with those of the folder's run, without writing anything.

    Raises:
        ValueError: they differ; the message names all differences.
        FileExistsError: the folder has results but no settings file.
    """
    remedy = "choose another folder by hydra.run.dir=..."
    if not (folder / file).is_file():
        if work := [name for name in RESULT_NAMES if (folder / name).exists()]:
            raise FileExistsError(
                f"{folder} holds {', '.join(work)} of another run without its {file}; {remedy}"
            )
        return
    expected = yaml_of(folder / file)
    plain = yaml.safe_load(yaml.safe_dump(dict(settings)))
    if changed := differences(plain, expected):
        raise ValueError(
            f"{folder} is the folder of a run with other settings: {'; '.join(changed)}; {remedy}"
        )


def differences(got: Any, expected: Any, key: str = "") -> list[str]:
    """List differing settings by their full names, with got and expected values; missing equals
    null.
    """
    if isinstance(got, Mapping) and isinstance(expected, Mapping):
        names = {f"{key}.{name}".lstrip("."): name for name in (*got, *expected)}
        return [
            line
            for full, name in names.items()
            for line in differences(got.get(name), expected.get(name), full)
        ]
    return [] if got == expected else [f"got {key}={shown(got)}, expected {shown(expected)}"]


def keep_measurement(folder: Path, data: "SceneData") -> None:
    """Write a run's rig, and the digests of rig and data files; for a resumed run compare them.

    Raises:
        Refused: the rig or a file has changed since the run started.
    """
    if (folder / DIGESTS_FILE).is_file():
        compare_measurement(folder, data.digests("train", "test"))
        return
    files.save(data.cameras, folder / RIG)
    write_text(folder / DIGESTS_FILE, json.dumps(data.digests("train", "test"), indent=1) + "\n")


def compare_measurement(folder: Path, got: Mapping[str, str]) -> None:
    """Compare digests with those in a run folder, if present.

    Raises:
        Refused: the rig or a file differs, or the digest file is invalid.
    """
    path = folder / DIGESTS_FILE
    if not path.is_file():
        return
    with file_errors(path, "is not JSON"):
        expected = json.loads(text_of(path))
    if not isinstance(expected, dict):
        raise Refused(f"{path}: expected digests by name, got {shown(expected)}")
    digests.compare(got, expected, f"{path} (its rig is kept as {RIG})")


def compare_versions(folder: Path, settings: Mapping[str, Any]) -> None:
    """Compare the versions with those in a run folder, if present.

    Warns:
        UserWarning: they differ, by more than the platform; the message names all differences.
    """
    if not (folder / VERSIONS).is_file():
        return
    lines = text_of(folder / VERSIONS).splitlines()
    before = {name: version for name, _, version in (line.partition(" ") for line in lines)}
    now = versions(settings.get("plugins"))
    changed = [
        f"{name} {before[name]} became {version}"
        for name, version in now.items()
        if name != "platform" and before.get(name, version) != version
    ]
    if changed:
        warnings.warn(
            f"{folder} began with other versions: {'; '.join(changed)}. Its existing results "
            f"are kept",
            stacklevel=3,
        )


def versions(plugins: Any = None, others: Iterable[str] = ()) -> dict[str, str]:
    """Versions of Python, of mvrecon, of its numerical dependencies, of installed plugins and of
    other distributions, and digests of the code of the modules that the setting `plugins` names,
    which are imported.

    Torch's own version includes the build (2.13.0+cu130), which the package index omits.
    """
    import torch

    packages = {
        "mvrecon": __version__,
        "python": platform.python_version(),
        "platform": platform.platform(),
    }
    packages["torch"] = str(torch.__version__)
    for name in (*PACKAGES, *others):
        try:
            packages[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            packages[name] = "not installed"
    packages |= {
        point.dist.name: point.dist.version for point in registry.installed() if point.dist
    }
    names = registry.names(plugins)
    return packages | {name: f"sha256:{code}" for name, code in digests.of_code(names).items()}


def start(folder: Path, settings: Mapping[str, Any], file: str = SETTINGS) -> None:
    """Write a run's settings, plain and resolved, and the versions."""
    write_text(folder / file, yaml.safe_dump(dict(settings), sort_keys=False))
    lines = versions(settings.get("plugins")).items()
    write_text(folder / VERSIONS, "".join(f"{name} {version}\n" for name, version in lines))


def read_settings(folder: Path) -> TrainSettings:
    """Read the settings of a training run.

    Raises:
        FileNotFoundError: not a run folder.
        Refused: the run is of version 0.1.0, or not of a training.
    """
    path = folder / SETTINGS
    if not path.is_file():
        raise FileNotFoundError(f"Expected a run folder with {SETTINGS} in it, got {folder}")
    settings = yaml_of(path)
    if isinstance(settings, dict) and ("model" in settings or "reconstructor" in settings):
        raise Refused(
            f"{path}: was written by mvrecon 0.1.0, expected 0.2.0 or later; train it "
            f"again, or use mvrecon 0.1.0"
        )
    with file_errors(path, "is not of mvrecon-train", "is it of another app or version?"):
        return TrainSettings(**settings)


def write_results(folder: Path, results: Mapping[str, object]) -> None:
    """Write `results.json` with the command and the versions; nan becomes null, infinity the text
    "inf" or "-inf", which `float` reads.
    """
    whole = {**results, "command": sys.argv, "versions": versions()}
    write_text(folder / RESULTS, json.dumps(_finite(whole), indent=2, allow_nan=False) + "\n")


def _finite(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _finite(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None if math.isnan(value) else str(value)
    return value
