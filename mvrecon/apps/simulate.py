"""`mvrecon-simulate`: simulates the views of a scene's cases, as images and numbers, with the
truth.
"""

import warnings
from collections.abc import Sequence
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path

from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig

from mvrecon.apps import scan_file
from mvrecon.apps.config import launch, record_of
from mvrecon.apps.settings import SimulateSettings
from mvrecon.core.registry import import_plugins

#: Maximum number of cases whose files the app prints.
MAX_SHOWN_CASES = 3
#: Bytes of a pixel and of a voxel in a case's files, about.
BYTES_PER_VALUE = 4


def simulate(settings: SimulateSettings, folder: Path) -> list[Path]:
    """Measure every case of `settings` and return the cases' folders in `<folder>/cases`.

    A case has its views as `views.h5` (counts with dose and duration) and images, its truth on the
    grid as `truth.nii.gz` (in HU if the scene is in 1/mm), the attenuation of an emitting scene
    with matter as `mu.nii.gz` (in 1/mm), and its affine map as `placement.json` if it came from a
    file.
    With `picture=mosaic`, one image, `mosaic.png`, has all views of a case.
    Its `scan.yaml` describes views, rig and grid for `mvrecon-reconstruct scan=...`.
    The folder also holds `config.yaml`, `versions.txt` and the rig as `rig.json`, for
    `camera=from_file`. With `rtk`, the rig is there as RTK's `geometry.xml`, too, in the axes IEC,
    where RTK's gantry turns about the z axis here, and every case has `projections`, see
    `export.save_greys`.

    Raises:
        RuntimeError: another process uses the folder.
        OSError: too little space for the cases.
        ValueError: the folder's run has other settings; another picture; `rtk` with a rig that RTK
            does not support, or with views other than attenuation.

    Warns:
        UserWarning: nibabel, which writes truth and attenuation, is not installed; the rig sees
            little of the grid, or of the first case's body.
    """
    import_plugins(settings.plugins)
    import torch
    from rich.console import Console
    from rich.progress import track

    from mvrecon.core.files.atomic import check_room
    from mvrecon.core.parts import CAMERAS, PROJECTORS, SCENES
    from mvrecon.data.acquisition.acquired import Acquired
    from mvrecon.data.acquisition.detector import Acquisition
    from mvrecon.data.dataset import SceneDataset
    from mvrecon.geometry.cameras import files
    from mvrecon.geometry.cameras.coverage import check_coverage, fitted
    from mvrecon.geometry.cameras.formats import rtk_xml
    from mvrecon.geometry.grid import Grid
    from mvrecon.report.viz import images, review
    from mvrecon.training import export, run_folder

    settings = replace(settings, camera=fitted(settings.camera, settings.grid))
    grid, cameras = Grid.centred(**settings.grid), CAMERAS.from_config(settings.camera)
    acquisition = Acquisition.of(settings.acquisition)
    scene = Acquired(SCENES.from_config(settings.scene), settings.projector, acquisition)
    cases = SceneDataset(scene, grid, cameras, settings.cases, settings.seed, cache=False)
    projector = settings.projector or {}
    takes_mu = bool(projector) and PROJECTORS.takes(projector["name"], "mu")
    unit, where = scene.unit_of_views(grid, cameras), folder / "cases"
    case_folders, nibabel = [], find_spec("nibabel")
    if not nibabel:
        warnings.warn(
            "Truth and attenuation are not written: NIfTI needs nibabel: pip install 'mvrecon[io]'",
            stacklevel=2,
        )
    # a file that cannot be read fails before any is written
    first = cases.sample(0) if len(cases) else None
    if settings.rtk:
        rtk_xml.check(cameras)
    if first is not None:
        if settings.rtk:
            export.check_greys(first.views)
        values = first.views.numel() + first.volume.numel()
        check_room(where, BYTES_PER_VALUE * values * len(cases))
    check_coverage(cameras, grid, bodies=() if first is None else [first.volume[0]])
    with run_folder.run_lock(folder, vars(settings), products=("geometry.xml",)):
        files.save(cameras, folder / run_folder.RIG)
        if settings.rtk:
            # RTK's FDK weights views by their gantry angles, about the file's y: z in IEC's axes
            rtk_xml.write(cameras, folder / "geometry.xml", "IEC")
        console = Console(stderr=True)
        for item in track(range(len(cases)), "Simulating", transient=True, console=console):
            case = cases.sample(item) if item or first is None else first
            index = settings.cases[item]
            name, mu = export.numbered(case.name, case_folders), case.maps.get("mu")
            attenuated = takes_mu and bool(projector.get("mu") if mu is None else mu.any())
            views, counted = case.views[0], (case.dose, acquisition.duration_s)
            own = export.save_views(where, name, views, unit, attenuated, *counted)
            case_folders.append(own)
            if settings.picture:
                image = review.mosaic(views, name, unit)
                images.save_png(own / "mosaic.png", image)
            else:
                top = max(views.amax().item(), torch.finfo(torch.float32).tiny)
                for m, view in enumerate(views):
                    image = images.grey(view, (0, top))  # black at 0
                    images.save_png(own / f"view_{m:03d}.png", image)
            description = {
                "views": {"path": str(own / "views.h5")},
                "camera": {"name": "from_file", "path": str(folder / run_folder.RIG)},
                "projector": settings.projector and dict(settings.projector),
                "grid": dict(settings.grid),
            }
            scan_file.save(own / scan_file.NAME, description)
            if settings.rtk:
                export.save_greys(own, views)
            if nibabel:
                mu = None if mu is None else mu[0]
                export.save_truth(own, case.volume[0], scene.unit, grid, mu)
            placement = scene.scene.placement(index, settings.seed, grid)
            if placement is not None:
                export.save_placement(own, placement)
    return case_folders


def report(case_folders: Sequence[Path], folder: Path) -> list[str]:
    """Lines about a run: its folder, the first cases' folders and their files."""
    lines = [f"{len(case_folders)} case(s) and rig.json written to {folder}"]
    for case in case_folders[:MAX_SHOWN_CASES]:
        names = sorted((path.name for path in case.iterdir()), key=lambda n: (n != "views.h5", n))
        pictures = [name for name in names if name.startswith("view_")]
        rest = [name for name in names if name not in pictures]
        counted = [f"{len(pictures)} pictures view_*.png"] * bool(pictures)
        lines.append(f"{case}: {', '.join(rest + counted)}")
    if len(case_folders) > MAX_SHOWN_CASES:
        lines.append(f"and {len(case_folders) - MAX_SHOWN_CASES} more")
    return lines


def task(config: DictConfig) -> None:
    """One run of the app."""
    from rich.console import Console

    folder = Path(HydraConfig.get().runtime.output_dir)
    case_folders = simulate(record_of(config, SimulateSettings), folder)
    for line in report(case_folders, folder):
        Console(markup=False, highlight=False).print(line, soft_wrap=True)


def main() -> None:
    """Entry point of `mvrecon-simulate`."""
    launch(task, "simulate")


if __name__ == "__main__":
    main()
