"""The methods of finished runs, read from their folders."""

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mvrecon.core.files.checks import Refused, file_errors, shown, yaml_of
from mvrecon.core.files.runs import EVALUATION, RESULTS, SETTINGS, flatten, read_results

#: Figures of merit that are compared; larger is better for those of `RISING`.
FIGURES, RISING = ("psnr", "ssim", "nrmse", "view_nrmse"), ("psnr", "ssim")
#: Settings that say nothing of what is compared, and the most that make up a run's name.
SILENT, NAMED = ("name", "label", "resume", "plugins", "checkpoint", "save"), 4
#: Characters of a value in a run's name, at most; values that are longer are numbered.
LONG = 32


@dataclass(frozen=True)
class Row:
    """One method of one run, judged on its test scenes.

    Args:
        run: what differs from the other runs.
        method: its label in the run.
        scenes: names of the test scenes, a patient each.
        figures: of merit by name, a value for each scene; nan where the volume has failed.
        failed: number of scenes whose volume holds NaN or infinity.
        ms: milliseconds of one reconstruction.
        train_seconds: of training.
        parameters: number of weights.
        peak_mb: memory that a reconstruction needs, in units of 2^20 bytes; nan: not known.
        folder: of the run.
    """

    run: str
    method: str
    scenes: tuple[str, ...]
    figures: Mapping[str, tuple[float, ...]]
    failed: int
    ms: float
    train_seconds: float
    parameters: int
    peak_mb: float
    folder: Path

    def mean(self, figure: str) -> float:
        """Mean of a figure over all scenes; nan where the method has failed in one."""
        values = self.figures[figure]
        return sum(values) / len(values) if values else math.nan


def read(places: Iterable[str | Path]) -> list[Row]:
    """The methods of all finished runs at some places: run folders, or folders with runs in them.

    Raises:
        FileNotFoundError: a place without a finished run.
        Refused: a file that is none of a run's.
    """
    folders = list(dict.fromkeys(run for place in places for run in _runs(Path(place))))
    names = _names(folders)
    return [row for folder, name in zip(folders, names, strict=True) for row in _rows(folder, name)]


def _runs(place: Path) -> list[Path]:
    runs = [path.parent for path in sorted(place.expanduser().rglob(RESULTS))]
    if not runs:
        raise FileNotFoundError(f"Expected a finished run (with {RESULTS}) in {place}, got none")
    return runs


def _rows(folder: Path, name: str) -> Iterator[Row]:
    table = read_results(folder)
    with file_errors(folder / RESULTS, "is no table of results"):
        yield from rows_of(table, name, folder)


def rows_of(table: Mapping[str, Any], run: str, folder: Path) -> Iterator[Row]:
    """The methods of a table of results, under a run's name."""
    for label, row in table["methods"].items():
        figures = {key: tuple(map(_number, row[key]["values"])) for key in FIGURES}
        yield Row(
            run=run,
            method=str(label),
            scenes=tuple(map(str, table["scenes"])),
            figures=figures,
            failed=sum(map(math.isnan, figures["ssim"])),  # a finite volume always has an SSIM
            ms=_number(row["ms_per_volume"]),
            train_seconds=_number(row["train_seconds"]),
            parameters=int(row["parameters"]),
            peak_mb=_number(row.get("peak_mb")),
            folder=folder,
        )


def _number(value: float | str | None) -> float:
    """A number of a table, in which nan is null, and infinity a text."""
    return math.nan if value is None else float(value)


def _names(folders: Sequence[Path]) -> list[str]:
    """Each run as its sweep calls it; else by the settings that differ, or by its folder where none
    does.
    """
    of_sweep = [folder.name for folder in folders]
    if len(set(of_sweep)) == len(folders) > 1 and all("=" in name for name in of_sweep):
        return of_sweep
    settings = [dict(_named(_settings(folder))) for folder in folders]
    keys = [key for key in dict.fromkeys(key for s in settings for key in s)]
    differing = [key for key in keys if len({repr(s.get(key)) for s in settings}) > 1]
    parts = {key.removesuffix(".name") for key in differing if key.endswith(".name")}
    telling = [key for key in differing if key.endswith(".name") or not _below(key, parts)]
    texts = {key: _texts([s.get(key) for s in settings]) for key in telling[:NAMED]}
    return [
        ", ".join(f"{key.removesuffix('.name')}={texts[key][k]}" for key in texts if key in s)
        or folder.name
        for k, (s, folder) in enumerate(zip(settings, folders, strict=True))
    ]


def _texts(values: Sequence[Any]) -> list[str]:
    """Values of one setting as texts; where one is too long for a name, all by their number."""
    texts = [str(value) for value in values]
    if max(map(len, texts)) <= LONG:
        return texts
    numbers = {text: f"#{k}" for k, text in enumerate(dict.fromkeys(texts), 1)}
    return [numbers[text] for text in texts]


def _below(key: str, parts: Iterable[str]) -> bool:
    """Whether a setting is an option of a part that differs itself."""
    return any(key.startswith(f"{part}.") for part in parts)


def _settings(folder: Path) -> Mapping[str, Any]:
    path = next(
        (folder / name for name in (EVALUATION, SETTINGS) if (folder / name).is_file()), None
    )
    settings = yaml_of(path) if path else {}
    if not isinstance(settings, Mapping):
        raise Refused(f"{path}: expected settings by name, got {shown(settings)}")
    return {key: value for key, value in settings.items() if key not in SILENT}


def _named(settings: Mapping[str, Any]) -> Iterator[tuple[str, Any]]:
    return ((".".join(map(str, keys)), value) for keys, value in flatten(settings))
