"""`mvrecon-eval`: recomputes the result table of a run from its checkpoints, on its own or other
test scenes.
"""

import math
from dataclasses import replace
from pathlib import Path

from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig

from mvrecon.apps.config import command_folder, launch, record_of, to_plain
from mvrecon.apps.settings import EvalSettings
from mvrecon.core.files.runs import EVALUATION, Results, folder_of_run, of_weights
from mvrecon.core.parts import Options
from mvrecon.core.registry import import_plugins
from mvrecon.training.settings import TrainSettings

#: Bytes of a voxel in a case's files, at most.
BYTES_PER_VOXEL = 4


def evaluate(options: EvalSettings, folder: Path) -> Results:
    """Evaluate a run's methods and write `results.json` (with `save`, the cases too) into a folder.

    Args:
        options: `checkpoint` (a run folder, or a checkpoint in one), and what differs from the
            run: `test_scene`, `acquisition`, `camera`, `grid`, `data`, further `compare`; `device`
            and `save`.
        folder: folder of the results, with `eval.yaml`, which is `options`, and `versions.txt`.

    Raises:
        FileNotFoundError: no checkpoint or no run is there.
        RuntimeError: another process uses the folder.
        ValueError: an unknown device; the run's rig or data have changed since; weights that do not
            fit the camera or the grid; the folder is another evaluation's; settings for a method
            that the run has trained, which its checkpoint decides.
        FileExistsError: the folder is a run's own.
        OSError: too little space for the cases.

    Warns:
        UserWarning: the rig sees little of the grid, or of the first cases' bodies.
    """
    import_plugins(options.plugins)
    from torch import Tensor

    from mvrecon.core.files.atomic import check_room
    from mvrecon.core.machine import device_of
    from mvrecon.data.dataset import Batch
    from mvrecon.geometry.cameras.coverage import check_coverage, fitted
    from mvrecon.training import checkpoints, evaluation, export, fit, run_folder
    from mvrecon.training.trained import check_trained

    device = device_of(options.device)
    run = folder_of_run(options.checkpoint)
    described = (label for label, model in (options.compare or {}).items() if model)
    if taken := [label for label in described if checkpoints.finished(run, label).exists()]:
        raise ValueError(
            f"compare describes {taken}, which the run has trained already; expected other labels"
        )
    trained = run_folder.read_settings(run)
    settings = merged(trained, options)
    import_plugins(settings.plugins)
    settings = replace(settings, camera=fitted(settings.camera, settings.grid))
    data = fit.build_data(settings)

    saved: list[Path] = []

    def save(scene: Batch, volumes: dict[str, Tensor]) -> None:
        case = export.save_case(folder / "cases", scene, volumes, data.grid, data.data_range, saved)
        saved.append(case)

    on_scene = save if options.save else None
    other_rig = bool(options.camera or options.grid)
    run_folder.compare_measurement(run, data.digests("test", rig=not other_rig))
    check_trained(settings.methods().values())
    ready = evaluation.loaded(settings, run, data, other_rig)
    if options.save:
        voxels = len(data.sets["test"]) * math.prod(data.grid.shape)
        check_room(folder / "cases", BYTES_PER_VOXEL * voxels * (1 + len(ready.trained)))
    check_coverage(data.cameras, data.grid, bodies=data.first_volumes())
    with run_folder.run_lock(folder, vars(options), EVALUATION):
        table = evaluation.results(settings, run, data, device, on_scene, ready)
        table["checkpoint"] = str(run)
        table["acquisition_of_run"] = trained.acquisition
        table["geometry"] = {"camera": settings.camera, "grid": settings.grid}
        table["geometry_of_run"] = {"camera": trained.camera, "grid": trained.grid}
        run_folder.write_results(folder, table)
    return table


def merged(run: TrainSettings, options: EvalSettings) -> TrainSettings:
    """A run's settings with the test scene, the acquisition, the camera, the grid, the data options
    and the compared methods that an evaluation gives.

    A camera with a name takes the place of the run's; without, its options change those of the
    run's. Cases are of one rig.
    """
    camera, grid = options.camera or {}, options.grid or {}
    sizes = {"size", "shape"} if {"size", "shape"} & set(grid) else set()
    kept = {key: value for key, value in run.grid.items() if key not in sizes}
    return replace(
        run,
        name=f"{run.name} ({options.name})",
        test_scene=options.test_scene or run.test_scene,
        acquisition={**(run.acquisition or {}), **(options.acquisition or {})},
        camera=camera if "name" in camera else over(run.camera, camera),
        grid={**kept, **grid},
        data={**over(run.data, options.data or {}), "rigs": 0},
        compare={**(run.compare or {}), **(options.compare or {})},
    )


def over(settings: Options, changes: Options) -> Options:
    """Settings with changes, mapping by mapping."""
    inner = {
        key: over(settings[key], value)
        for key, value in changes.items()
        if isinstance(value, dict) and isinstance(settings.get(key), dict)
    }
    return {**settings, **changes, **inner}


def task(config: DictConfig) -> None:
    """One run of the app; returns nothing that a sweeper could choose by: these are test scenes."""
    with command_folder():
        # before torch is imported, which takes long
        folder_of_run(of_weights(to_plain(config)["checkpoint"]))
    from mvrecon.report.result_table import show

    options = record_of(config, EvalSettings)
    folder = Path(HydraConfig.get().runtime.output_dir)
    table = evaluate(options, folder)
    show(table, folder)


def main() -> None:
    """Entry point of `mvrecon-eval`."""
    launch(task, "eval")


if __name__ == "__main__":
    main()
