"""`mvrecon-train`: trains a method and those it is compared with, then prints the table of unseen
scenes.

Torch is imported inside the task, so that `--help` and errors in settings are fast.
"""

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
from omegaconf import DictConfig

from mvrecon.apps.config import launch, record_of
from mvrecon.apps.config.guard import as_typed
from mvrecon.core.files.runs import RESULTS, Results, folder_of_run, read_results
from mvrecon.core.machine import rank, silence_libraries
from mvrecon.core.registry import import_plugins
from mvrecon.training.settings import TrainSettings

#: The one setting that a resumed run takes.
RESUMED_SETTING = "trainer.max_steps"


def train(
    settings: TrainSettings, folder: Path, overrides: Sequence[str] = (), steps: int | None = None
) -> Results:
    """Train every method of `settings` in a run folder, or resume its training; returns the
    results.

    All parts are built, and all cases computed, before anything in the folder changes.

    On several devices only the first process writes and evaluates; the others return nothing. The
    folder then holds `config.yaml`, `versions.txt`, `rig.json`, `digests.json`, logs,
    `checkpoints/`, `review/` and `results.json`.

    Args:
        settings: settings of the run.
        folder: folder of the run.
        overrides: options on the command line, for TensorBoard.
        steps: trainer.max_steps from now on, more than in the settings of the folder's run; None:
            as there.

    Raises:
        RuntimeError: another process uses the folder.
        ValueError: an unknown accelerator; the folder's run has other settings, another rig or
            other data; fewer steps than it has; what the parts raise.

    Warns:
        UserWarning: the rig sees little of the grid, or of the first cases' bodies.
    """
    silence_libraries()  # again: a sweep's run may be in a process of its own
    import_plugins(settings.plugins)
    from mvrecon.core.machine import device_of
    from mvrecon.geometry.cameras.coverage import check_coverage, fitted
    from mvrecon.training import evaluation, fit, resume, run_folder, tensorboard

    settings = replace(settings, camera=fitted(settings.camera, settings.grid))
    before = settings
    if steps is not None:
        settings = resume.extended(settings, folder, steps)
    device = device_of(settings.trainer.get("accelerator", "auto"))
    data = fit.build_data(settings)
    if rank() > 0:
        fit.fit_all(settings, data, folder)
        return {}
    run_folder.check(folder, vars(before))
    run_folder.compare_measurement(folder, data.digests("train", "test"))
    fit.check(settings, data, folder, again=settings != before)
    check_coverage(data.cameras, data.grid, bodies=data.first_volumes())
    if settings != before:
        resume.extend_training(before, settings, folder)
    with run_folder.run_lock(folder, vars(settings)):
        run_folder.keep_measurement(folder, data)
        with fit.started(folder, settings.trainer):
            fit.fit_all(settings, data, folder)
        slices = tensorboard.Slices(folder, settings, data.grid, data.data_range, data.unit)
        table = evaluation.results(settings, folder, data, device, slices)
        table["validation_psnr"] = evaluation.validation_psnr(settings, folder, data, device)
        tensorboard.log_results(folder, settings, table, overrides)
        run_folder.write_results(folder, table)
    return table


def resumed(folder: Path, others: Sequence[str]) -> tuple[TrainSettings, Path]:
    """Settings and folder of a run to resume.

    Args:
        folder: folder of the run, or a checkpoint in it.
        others: further options of the command line.

    Raises:
        ValueError: other options, which a resumed run cannot apply.
        FileNotFoundError: no run folder is there.
    """
    from mvrecon.training import run_folder

    if others:
        raise ValueError(
            f"resume=... keeps the run's own settings, and takes {RESUMED_SETTING}=... for more "
            f"steps; got {' '.join(others)}"
        )
    run = folder_of_run(folder)
    return run_folder.read_settings(run), run


def task(config: DictConfig) -> float:
    """One run of the app; returns the main method's PSNR on the validation scenes in dB, for
    sweepers, which must not see the test scenes.
    """
    from mvrecon.geometry.cameras.coverage import fitted
    from mvrecon.report.result_table import show
    from mvrecon.training import run_folder
    from mvrecon.training.callbacks import tell

    settings = record_of(config, TrainSettings)
    folder, steps = Path(HydraConfig.get().runtime.output_dir), None
    if settings.resume:
        import_plugins(settings.plugins)
        lines = as_typed(HydraConfig.get())
        keys = {line: line.lstrip("+").partition("=")[0] for line in lines}
        others = [
            line for line in lines if keys[line] not in ("resume", "plugins", RESUMED_SETTING)
        ]
        steps = settings.trainer["max_steps"] if RESUMED_SETTING in keys.values() else None
        settings, folder = resumed(settings.resume, others)
    else:
        settings = replace(settings, camera=fitted(settings.camera, settings.grid))
    run_folder.check(folder, vars(settings))
    finished = (folder / RESULTS).is_file() and steps in (None, settings.trainer["max_steps"])
    if finished and HydraConfig.get().mode is RunMode.MULTIRUN:  # of a sweep that is begun again
        tell(f"{folder.name}: its results are there already")
        return _score(read_results(folder))
    if table := train(settings, folder, as_typed(HydraConfig.get()), steps):
        show(table, folder)
    return _score(table)


def _score(table: Results) -> float:
    score = table.get("validation_psnr")
    return math.nan if score is None else float(score)


def main() -> None:
    """Entry point of `mvrecon-train`."""
    launch(task, "train")


if __name__ == "__main__":
    main()
