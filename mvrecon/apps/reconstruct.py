"""`mvrecon-reconstruct`: a volume from measured views, with its pictures, time and memory."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig

from mvrecon.apps.config import ReconstructSettings, launch, to_plain
from mvrecon.core.files.atomic import check_writable
from mvrecon.core.files.runs import RESULTS, SETTINGS, VERSIONS, flatten
from mvrecon.core.registry import import_plugins

if TYPE_CHECKING:
    from torch import Tensor

    from mvrecon.apps.run_method import Outcome
    from mvrecon.geometry.grid import Grid

UNITS = ("1/mm", "HU")
#: What a run writes into its folder beside the volume.
WRITTEN = (
    SETTINGS,
    VERSIONS,
    "rig.json",
    "rig.png",
    "planes.png",
    "cameras.png",
    RESULTS,
)


def reconstruct(settings: ReconstructSettings, folder: Path) -> dict[str, Any]:
    """Reconstruct a measured scan; returns what `results.json` then holds.

    The folder gets `config.yaml`, `versions.txt`, `rig.json`, `rig.png`, `planes.png`,
    `results.json` and, unless `out` names another file, the volume; with `correct=align` also
    `cameras.png`. Beside the volume lie a rig that was calibrated (`calibrate`), too, as
    `<volume>.cameras.json`, and the standard deviation of the volume's error, where a network tells
    it, as `<volume>.sigma.nii.gz` in the volume's unit. A run that fails leaves none of them, so
    that the folder is free for a second try.

    Raises:
        RuntimeError: another process is at work in the folder.
        OSError: the volume cannot be written.
        ValueError: the folder's run has other settings; an input would be written to; views, rig,
            grid or method do not fit.
    """
    import_plugins(settings.plugins)
    from mvrecon.apps import correction, run_method, sanity_checks, scan
    from mvrecon.core.machine import device_of
    from mvrecon.data.volume_files import check_ending
    from mvrecon.geometry.cameras import files
    from mvrecon.report import metrics
    from mvrecon.report.viz import review, rig
    from mvrecon.training import export, run_folder

    method, unit, free = settings.method, settings.unit, settings.calibrate
    if unit not in UNITS:
        raise ValueError(f"Expected the unit 1/mm or HU, got {unit!r}")
    out = Path(settings.out or folder / "volume.nii.gz").expanduser()
    check_ending(out)
    _check_places(settings, out, folder)
    case = scan.open_scan(
        settings.views, settings.camera, settings.grid, settings.projector, method
    )
    if unit == "HU" and case.unit != scan.ATTENUATION:
        raise ValueError(f"Expected attenuation in 1/mm for the unit HU, got {case.unit}")
    if free:
        correction.check_calibration(free, case)
    # before the folder is claimed
    stop_sigma, choose = settings.stop["sigma"], settings.choose
    run_method.check_method(method, stop_sigma, choose)
    correction.check_correction(settings.correct, settings.self_calibrate)
    estimate, alignment, device = None, None, device_of(settings.device)
    with run_folder.run_lock(folder, vars(settings), products=WRITTEN):
        if free:
            case, estimate = correction.calibrate(case, free, device)
            files.save(case.cameras, sibling_path(out))
        if settings.correct is not None:
            case, alignment = correction.corrected_scan(
                case, settings.correct, settings.self_calibrate, device
            )
        if alignment is not None:
            image = review.alignments(alignment.shift_px[0], alignment.gain[0])
            export.save_png(folder / "cameras.png", image)
        files.save(case.cameras, folder / "rig.json")
        export.save_png(folder / "rig.png", rig.picture(case.cameras, case.grid))
        outcome = run_method.run_method(case, method, stop_sigma, choose, device)
        shown = review.Case(out.name, case.grid, 1.0, case.unit)
        export.save_png(folder / "planes.png", review.scan(shown, outcome.volume))
        _save(out, outcome, unit, case.grid)
        table = {
            "name": settings.name,
            "method": method["name"],
            "volume": str(out),
            "unit": "HU" if unit == "HU" else case.unit,
            "grid": {"shape": list(case.grid.shape), "spacing_mm": list(case.grid.spacing)},
            "views": {"count": len(case.cameras), "shape": list(case.cameras.shape)},
            **outcome.row(),
            "percentiles_1_99": _percentiles(outcome.volume, unit),
            "sanity_checks": sanity_checks.sanity_checks(
                case, method["name"], outcome.view_nrmse, device
            ),
            "left_out": run_method.left_out(case, method, device) if settings.left_out else None,
            **metrics.camera_row([metrics.cameras_of(alignment, {})]),
        }
        if estimate is not None:
            fit = correction.calibration_table(estimate, free)
            table["calibration"] = fit | {"cameras": str(sibling_path(out))}
        run_folder.write_results(folder, table)
    return table


def _save(out: Path, outcome: "Outcome", unit: str, grid: "Grid") -> None:
    """Write the volume and, where there is one, its standard deviation beside it, in the unit."""
    from mvrecon.data.attenuation import hounsfield
    from mvrecon.data.volume_files import save_volume

    volume, sigma = outcome.volume, outcome.sigma
    in_hu = unit == "HU"
    save_volume(out, hounsfield(volume) if in_hu else volume, grid)
    if sigma is None:
        return
    if in_hu:  # half of what lies between, as the scale bends at water
        sigma = (hounsfield(volume + sigma) - hounsfield(volume - sigma)) / 2
    save_volume(sibling_path(out, ".sigma.nii.gz"), sigma, grid)


def _percentiles(volume: "Tensor", unit: str) -> list[float]:
    """The 1st and the 99th percentile of a volume in the unit; of a large one, of every n-th
    voxel.
    """
    from mvrecon.data.attenuation import hounsfield

    values = volume.flatten()[:: 1 + volume.numel() // 2**20].double()
    ends = values.quantile(values.new_tensor([0.01, 0.99]))
    return (hounsfield(ends) if unit == "HU" else ends).tolist()


def sibling_path(volume: Path, ending: str = ".cameras.json") -> Path:
    """The file beside a volume with its name and another ending, that of a calibrated rig."""
    from mvrecon.data.volume_files import name_of

    return volume.with_name(name_of(volume) + ending)


def _check_places(settings: ReconstructSettings, out: Path, folder: Path) -> None:
    """Check that the volume can be written, and that no input is written to.

    Raises:
        ValueError: a file that the run writes is one that the settings name as an input.
        OSError: a place that cannot be written.
    """
    check_writable(out)
    written = [out, sibling_path(out, ".sigma.nii.gz"), *(folder / name for name in WRITTEN)]
    if settings.calibrate:
        written.append(sibling_path(out))
    places = {path.resolve() for path in written}
    for keys, value in flatten({**vars(settings), "out": None}):
        if isinstance(value, str) and Path(value).expanduser().resolve() in places:
            raise ValueError(
                f"Expected an input that the run does not write, got {'.'.join(keys)}={value}; "
                f"choose another out or hydra.run.dir"
            )


def task(config: DictConfig) -> None:
    """One run of the app."""
    from rich.console import Console

    from mvrecon.data.attenuation import WATER
    from mvrecon.report.metrics import disturbed_cameras, little_weight
    from mvrecon.training.run_folder import absolute_paths

    folder = Path(HydraConfig.get().runtime.output_dir)
    settings = ReconstructSettings(**absolute_paths(to_plain(config)))
    table = reconstruct(settings, folder)
    peak = table["peak_bytes"]
    memory = "" if peak is None else f", {peak / 2**30:.2f} GiB at most"
    console = Console(markup=False, highlight=False)
    if fit := table.get("calibration"):
        console.print(f"calibrate: {fit['words']}; {fit['cameras']}", soft_wrap=True)
    low, high = table["percentiles_1_99"]
    water = {"HU": " (water: 0)", "1/mm": f" (water: {WATER})"}.get(table["unit"], "")
    console.print(
        f"{table['method']}: {table['seconds']:.2f} s{memory}, view NRMSE "
        f"{table['view_nrmse']:.3g}; {table['volume']}; pictures in {folder}",
        f"values: 1st to 99th percentile {low:.3g} to {high:.3g} {table['unit']}{water}",
        *disturbed_cameras(table.get("cameras")),
        *little_weight(table["camera_weights"]),
        *(f"sanity check: {words}" for words in table["sanity_checks"]),
        sep="\n",
        soft_wrap=True,
    )


def main() -> None:
    """Entry point of `mvrecon-reconstruct`."""
    launch(task, "reconstruct")


if __name__ == "__main__":
    main()
