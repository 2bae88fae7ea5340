"""Files of a run folder by name: individual settings, tables of results and figures (CSV), and
weights.
"""

import csv
import json
import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NotRequired

from typing_extensions import TypedDict

from mvrecon.core.files.atomic import check_plain, written_whole
from mvrecon.core.files.checks import Refused, file_errors, from_home, shown, text_of

SETTINGS, EVALUATION, VERSIONS, RESULTS = "config.yaml", "eval.yaml", "versions.txt", "results.json"
#: Trained weights that are part of mvrecon.
WEIGHTS_FOLDER = Path(__file__).parents[2] / "weights"


class Figure(TypedDict, total=False):
    """A figure over the test scenes: mean, sample standard deviation and the value of each; of an
    error estimate also its rank correlation with the true error.
    """

    mean: float
    std: float
    values: list[float]
    rank: float


class MethodRow(TypedDict, extra_items=Figure):
    """A method in a table of results: its costs, and its figures of merit by name."""

    parameters: int
    train_steps: int
    train_seconds: float
    ms_per_volume: float
    peak_mb: float | None
    failed: NotRequired[list[str]]
    quality: NotRequired[dict[str, Figure]]
    cameras: NotRequired[dict[str, Any]]


class Results(TypedDict, total=False):
    """A table of results, of a training or an evaluation.

    Attributes:
        scene: settings of the test scenes.
        truths: mean and root mean square of each true volume.
        acquisition: options of the views' detector.
        units: unit of each figure, by name.
        checkpoint, acquisition_of_run, geometry, geometry_of_run: only in an evaluation: path of
            the checkpoint; the detector of the run; rig and grid of the evaluation and of the run.
    """

    name: str
    seed: int
    scene: Mapping[str, Any]
    scenes: list[str]
    truths: list[list[float]]
    grid: dict[str, list[Any]]
    seen_in_training: list[str] | None
    overlap: bool
    projector: Mapping[str, Any]
    acquisition: Mapping[str, Any] | None
    data_range: float
    device: str
    threads: int
    units: dict[str, str]
    methods: dict[str, MethodRow]
    validation_psnr: float | None
    checkpoint: str
    acquisition_of_run: Mapping[str, Any] | None
    geometry: Mapping[str, Any]
    geometry_of_run: Mapping[str, Any]


def folder_of_run(path: str | Path) -> Path:
    """Return the run folder of a path: itself, its `checkpoints` folder, or a checkpoint in it.

    Raises:
        FileNotFoundError: the path does not exist, or is not in a run folder.
        PermissionError: the run folder holds anything but files and folders.
    """
    if not from_home(path).exists():
        raise FileNotFoundError(f"No checkpoint or run folder is at {os.path.abspath(path)}")
    folder = run_around(path)
    if folder is None:
        raise FileNotFoundError(
            f"Expected a checkpoint in a run folder (one with {SETTINGS}), got {path}"
        )
    check_plain(folder)
    return folder.resolve()


def run_around(path: str | Path) -> Path | None:
    """The folder with a run's settings at or around a path, up to three levels above; None if there
    is none.
    """
    path = Path(os.path.abspath(from_home(path)))  # without following links yet
    folders = (path, *path.parents[:3])
    return next((folder for folder in folders if (folder / SETTINGS).is_file()), None)


def read_results(folder: Path) -> Results:
    """Read a run's table of results.

    Raises:
        Refused: it is missing or invalid.
    """
    path = folder / RESULTS
    with file_errors(path, "is no table of results"):
        table: Any = json.loads(text_of(path))
    if "methods" not in (table if isinstance(table, dict) else ()):
        raise Refused(f"{path}: expected a table of results, got {shown(table)}")
    return table


def flatten(settings: Any, keys: tuple[Any, ...] = ()) -> Iterator[tuple[tuple[Any, ...], Any]]:
    """List the values of nested mappings with their keys, outermost first; an empty mapping is a
    value.
    """
    if isinstance(settings, Mapping) and settings:
        for key, value in settings.items():
            yield from flatten(value, (*keys, key))
    else:
        yield keys, settings


def write_rows(path: str | Path, rows: Sequence[Mapping[str, object]]) -> None:
    """Write a CSV file atomically; the names of the first row are its header.

    Raises:
        ValueError: a row with a name that is not in the first.
    """
    with written_whole(path) as part, part.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, list(rows[0]), lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)


def read_rows(path: str | Path) -> list[dict[str, str]]:
    """Read the rows of a CSV file with texts as values; empty if the file does not exist."""
    if not Path(path).exists():
        return []
    with open(path, newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


def shipped_weights() -> dict[str, Path]:
    """The files of trained weights that are part of mvrecon, by name."""
    return {path.stem: path for path in sorted(WEIGHTS_FOLDER.glob("*.safetensors"))}


def of_weights(path: str | os.PathLike[str]) -> Path:
    """The absolute path of a checkpoint; if it does not exist, a name may be that of weights in
    mvrecon.
    """
    local = from_home(path)
    return (
        local.absolute() if local.exists() else shipped_weights().get(str(path), local.absolute())
    )


def _texts(value: Any) -> Iterator[str]:
    """The texts of a value, or within nested lists and mappings."""
    if isinstance(value, str):
        yield value
    elif isinstance(value, list | tuple | Mapping):
        for item in value.values() if isinstance(value, Mapping) else value:
            yield from _texts(item)


def check_inputs(settings: Mapping[str, Any], written: Iterable[Path]) -> None:
    """Check that no path in settings is of a file that a run writes, also through links, in lists
    and products (`a.nii * b.nii`), and of data sets (`file.h5:views`).

    Raises:
        ValueError: one is; the message names the setting.
    """
    places = {path.resolve() for path in written}
    for keys, value in flatten(settings):
        names = [name for text in _texts(value) for name in text.split(" * ")]
        files = [*names, *(name.rpartition(":")[0] for name in names)]
        if any(from_home(name).resolve() in places for name in files):
            raise ValueError(
                f"Expected an input that the run does not write, got "
                f"{'.'.join(map(str, keys))}={value}; choose another hydra.run.dir (or out)"
            )
