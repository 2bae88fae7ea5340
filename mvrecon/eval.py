"""`mvrecon-eval`: the result table of a run again, from its checkpoints, on its own test scenes or
on others.
"""

from pathlib import Path
from typing import Any

from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig

from mvrecon.config import launch, to_plain
from mvrecon.config.plugins import import_plugins


def evaluate(options: dict[str, Any], folder: Path) -> dict[str, Any]:
    """Evaluate a run's methods and write `results.json` (with `save`, the cases too) into a folder.

    Args:
        options: `checkpoint` (a run folder, or a checkpoint in one), and what shall differ from the
            run: `test_scene`, `acquisition`, `data`, further `compare`; `device` and `save`.
        folder: where the results go, with `eval.yaml`, which is `options`, and `versions.txt`.

    Raises:
        FileNotFoundError: no checkpoint or no run is there.
        RuntimeError: another process is at work in the folder.
        ValueError: an unknown device; the run was made with another rig or other data; the folder
            is another evaluation's; settings for a method that the run has trained, which its
            checkpoint decides.
        FileExistsError: the folder is a run's own.
    """
    import_plugins(options["plugins"])
    from mvrecon.engine import checkpoints, evaluation, export, fit, run_folder

    device = evaluation.device_of(options["device"])
    run = checkpoints.run_folder(options["checkpoint"])
    described = (label for label, model in options["compare"].items() if model)
    if trained := [label for label in described if checkpoints.finished(run, label).exists()]:
        raise ValueError(
            f"compare describes {trained}, which the run has trained already; expected other labels"
        )
    trained = run_folder.read_settings(run)
    settings = merged(trained, options)
    import_plugins(settings["plugins"])
    data = fit.build_data(settings)

    def save(scene: dict[str, Any], volumes: dict[str, Any]) -> None:
        export.save_case(folder / "cases", scene, volumes, data.grid, data.data_range)

    see = save if options["save"] else None
    run_folder.compare_measurement(run, data.digests("test"))
    with run_folder.taken(folder, options, run_folder.EVALUATION):
        table = evaluation.results(settings, run, data, device, see)
        table["checkpoint"] = str(run)
        table["acquisition_of_run"] = trained["acquisition"]
        run_folder.write_results(folder, table)
    return table


def merged(run: dict[str, Any], options: dict[str, Any]) -> dict[str, Any]:
    """A run's settings with the test scene, the acquisition, the data options and the compared
    methods that an evaluation gives.
    """
    data = {**run["data"], **(options["data"] or {})}
    data["sizes"] = {**run["data"]["sizes"], **(data["sizes"] or {})}
    scene = options["test_scene"] or run["test_scene"]
    acquisition = {**run["acquisition"], **(options["acquisition"] or {})}
    compare = {**run["compare"], **options["compare"]}
    return {
        **run,
        "name": f"{run['name']} ({options['name']})",
        "test_scene": scene,
        "acquisition": acquisition,
        "data": data,
        "compare": compare,
    }


def task(config: DictConfig) -> None:
    """One run of the app; returns nothing that a sweeper could choose by: these are test scenes."""
    from mvrecon.engine.report import show
    from mvrecon.engine.run_folder import anchored

    folder = Path(HydraConfig.get().runtime.output_dir)
    table = evaluate(anchored(to_plain(config)), folder)
    show(table, folder)


def main() -> None:
    """Entry point of `mvrecon-eval`."""
    launch(task, "eval")


if __name__ == "__main__":
    main()
