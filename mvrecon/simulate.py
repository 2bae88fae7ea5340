"""`mvrecon-simulate`: the views of a scene's cases as a rig measures them, as images and as
numbers.
"""

from pathlib import Path
from typing import Any

from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig

from mvrecon.config import launch, to_plain
from mvrecon.config.plugins import import_plugins


def simulate(settings: dict[str, Any], folder: Path) -> list[Path]:
    """Measure every case of `settings` and return their folders, one a case in `<folder>/cases`.

    The folder also holds `config.yaml`, `versions.txt` and the rig as `cameras.json`, for
    `camera=from_file`. A view is a line integral: its unit is the scene's times mm.

    Raises:
        RuntimeError: another process is at work in the folder.
        ValueError: the folder's run has other settings.
    """
    import_plugins(settings["plugins"])
    from rich.console import Console
    from rich.progress import track

    from mvrecon.cameras import files
    from mvrecon.data.dataset import SceneDataset
    from mvrecon.engine import export, run_folder
    from mvrecon.geometry.grid import Grid
    from mvrecon.parts import CAMERAS, SCENES

    grid, cameras = Grid.centred(**settings["grid"]), CAMERAS.from_config(settings["camera"])
    scene = SCENES.from_config(settings["scene"])
    cases = SceneDataset(scene, grid, cameras, settings["cases"], settings["seed"], cache=False)
    case_folders = []
    with run_folder.taken(folder, settings):
        files.save(cameras, folder / "cameras.json")
        for item in track(
            range(len(cases)), "Simulating", transient=True, console=Console(stderr=True)
        ):
            case = cases[item]
            case_folders.append(
                export.save_views(
                    folder / "cases", case["name"], case["views"][0], f"{scene.unit} * mm"
                )
            )
    return case_folders


def task(config: DictConfig) -> None:
    """One run of the app."""
    from rich.console import Console

    from mvrecon.engine.run_folder import anchored

    folder = Path(HydraConfig.get().runtime.output_dir)
    case_folders = simulate(anchored(to_plain(config)), folder)
    Console(markup=False, highlight=False).print(
        f"{len(case_folders)} case(s) written to {folder}", soft_wrap=True
    )


def main() -> None:
    """Entry point of `mvrecon-simulate`."""
    launch(task, "simulate")


if __name__ == "__main__":
    main()
