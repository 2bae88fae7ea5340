"""`mvrecon-train`: train a method and those it is compared with, then print the table of unseen
scenes.

Torch is imported inside the task, so that `--help` and typing mistakes are answered at once.
"""

import logging
import warnings
from pathlib import Path
from typing import Any

from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig

from mvrecon.config import launch, to_plain
from mvrecon.config.plugins import import_plugins


def train(settings: dict[str, Any], folder: Path) -> dict[str, Any]:
    """Train every method of `settings` in a run folder, or resume its training; returns the
    results.

    The folder then holds `config.yaml`, `versions.txt`, `rig.json`, `digests.json`, logs,
    `checkpoints/`, `review/` and `results.json`.

    Raises:
        RuntimeError: another process is at work in the folder.
        ValueError: an unknown accelerator; the folder's run has other settings, another rig or
            other data.
    """
    import_plugins(settings["plugins"])
    from mvrecon.engine import evaluation, fit, run_folder

    logging.getLogger("lightning.pytorch").setLevel(logging.WARNING)
    # Lightning's own use of torch, of which no user can be rid
    warnings.filterwarnings("ignore", r"`isinstance\(treespec, LeafSpec\)` is deprecated")
    device = evaluation.device_of(settings["trainer"].get("accelerator", "auto"))
    data = fit.build_data(settings)
    with run_folder.taken(folder, settings):
        run_folder.keep_measurement(folder, data)
        for method in fit.methods(settings):
            fit.fit(method, settings, data, folder)
        table = evaluation.results(settings, folder, data, device)
        run_folder.write_results(folder, table)
    return table


def resumed(folder: str, others: list[str]) -> tuple[dict[str, Any], Path]:
    """Settings and folder of a run to resume.

    Raises:
        ValueError: other options were given, which a resumed run could not honour.
        FileNotFoundError: no run folder is there.
    """
    from mvrecon.engine import checkpoints, run_folder

    if others:
        raise ValueError(
            f"resume goes on with the run's own settings; but got also {' '.join(others)}"
        )
    run = checkpoints.run_folder(folder)
    return run_folder.read_settings(run), run


def task(config: DictConfig) -> float:
    """One run of the app; returns the main method's mean PSNR in dB, for sweepers."""
    from mvrecon.engine import run_folder
    from mvrecon.engine.report import show

    settings = run_folder.anchored(to_plain(config))
    folder = Path(HydraConfig.get().runtime.output_dir)
    if settings["resume"]:
        import_plugins(settings["plugins"])
        others = [
            override
            for override in HydraConfig.get().overrides.task
            if not override.lstrip("+").startswith(("resume=", "plugins="))
        ]
        settings, folder = resumed(settings["resume"], others)
    run_folder.check(folder, settings)
    table = train(settings, folder)
    show(table, folder)
    return next(iter(table["methods"].values()))["psnr"]["mean"]


def main() -> None:
    """Entry point of `mvrecon-train`."""
    launch(task, "train")


if __name__ == "__main__":
    main()
