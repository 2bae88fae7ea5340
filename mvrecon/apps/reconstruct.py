"""`mvrecon-reconstruct`: reconstructs measured views; reports pictures, time and memory."""

import logging
import math
import sys
from collections.abc import Mapping, Sequence
from dataclasses import replace
from glob import escape, glob
from pathlib import Path
from tempfile import gettempdir
from typing import TYPE_CHECKING, Any

from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig

from mvrecon.apps.config import absolute_paths, command_folder, launch, to_plain
from mvrecon.apps.config.errors import PROGRAM_FAULTS, USER_ERRORS, sentence
from mvrecon.apps.settings import ReconstructSettings
from mvrecon.core.files.atomic import check_room, check_writable, written_or_kept
from mvrecon.core.files.runs import RESULTS, SETTINGS, VERSIONS, flatten
from mvrecon.core.options import describe, with_paths
from mvrecon.core.registry import import_plugins

if TYPE_CHECKING:
    from torch import Tensor

    from mvrecon.apps.run_method import Outcome

#: The option of rigs on a circle whose default is that of a simulated one.
ARC_OPTION = "arc_degrees"
#: Bytes of a voxel in the volume's file, at most.
BYTES_PER_VOXEL = 4
#: What a run writes into its folder beside the volume.
PRODUCTS = (
    SETTINGS,
    VERSIONS,
    "rig.json",
    "rig.png",
    "planes.png",
    "cameras.png",
    RESULTS,
)
#: Ends the warning of a scan that sees little of the grid.
SMALLER_GRID_HINT = (
    "without grid.* the grid is what all views see, and with grid.seen_by=0.5 alone what half of "
    "them see"
)


def reconstruct(settings: ReconstructSettings, folder: Path) -> dict[str, Any]:
    """Reconstruct a measured scan; returns the contents of `results.json`.

    The folder gets `config.yaml`, `versions.txt`, `rig.json`, `rig.png`, `planes.png`,
    `results.json` and, unless `out` names another file, the volume; with `correct=align` also
    `cameras.png`. Beside the volume, `calibrate` writes the rig as `<volume>.cameras.json`, and a
    network that estimates the standard deviation of its error `<volume>.sigma.nii.gz`, in the
    volume's unit. A failed run removes its files, so that the folder can be used again, except a
    computed volume. Ctrl-C ends an iterative method with its last iterate, number `stopped`.

    Raises:
        RuntimeError: another process uses the folder.
        OSError: the volume cannot be written, as on a disk without space for it; a computed one is
            kept elsewhere, and the message says where.
        ValueError: the folder's run has other settings; an input would be written to; views, rig,
            grid, method or the volume's file do not fit.
        KeyboardInterrupt: Ctrl-C before the first iterate, or in a method that does not iterate.

    Warns:
        UserWarning: the views see little of the grid.
    """
    import_plugins(settings.plugins)
    from mvrecon.apps import correction, run_method, sanity_checks, scan
    from mvrecon.apps.progress import Bar
    from mvrecon.core.machine import device_of
    from mvrecon.data.attenuation import hounsfield
    from mvrecon.data.volume_files import save_volume, volume_writer
    from mvrecon.geometry.cameras import files
    from mvrecon.geometry.cameras.coverage import check_coverage
    from mvrecon.report.cameras import camera_row, cameras_of
    from mvrecon.report.viz import review, rig
    from mvrecon.training import export, run_folder

    method, unit, free = settings.method, settings.unit, settings.calibrate
    out = check_places(settings, folder)
    case = scan.open_scan(
        settings.views, settings.camera, settings.grid, settings.projector, method, settings.scatter
    )
    as_read, align = case.measured, settings.correct is not None
    others = (free, align, settings.choose, settings.left_out)
    if settings.scatter is not None and any(others):
        raise ValueError(
            "Expected scatter without calibrate, correct, choose and left_out, which have none"
        )
    if unit == "HU" and case.unit != scan.ATTENUATION:
        raise ValueError(f"Expected attenuation in 1/mm for the unit HU, got {case.unit}")
    if unit != "HU":
        unit = case.unit
    volume_writer(out, case.grid, unit)
    check_room(out, BYTES_PER_VOXEL * math.prod(case.grid.shape))
    if free:
        correction.check_calibration(free, case)
    # before the folder is claimed
    stop_sigma, choose = settings.stop["sigma"], settings.choose
    run_method.check_method(method, stop_sigma, choose)
    if settings.self_calibrate and not align:
        raise ValueError("expected correct=align for self_calibrate=true, got correct=null")
    estimate, alignment, device = None, None, device_of(settings.device)
    check_coverage(case.cameras, case.grid, SMALLER_GRID_HINT)
    with run_folder.run_lock(folder, vars(settings), products=PRODUCTS), Bar() as bar:
        if free:
            case, estimate = correction.calibrate(case, free, device, bar)
            files.save(case.cameras, sibling_path(out))
            case = replace(case, grid=scan.grid_of(settings.grid, method, case.cameras))
        if settings.correct is not None:
            bar.phase("aligning")
            case, alignment = correction.corrected_scan(
                case, settings.correct, settings.self_calibrate, device
            )
        if alignment is not None:
            image = review.alignments(alignment.shift_px[0], alignment.gain[0])
            export.save_png(folder / "cameras.png", image)
        files.save(case.cameras, folder / "rig.json")
        export.save_png(folder / "rig.png", rig.picture(case.cameras, case.grid))
        outcome = run_method.run_method(case, method, stop_sigma, choose, device, bar)
        bar.phase("writing")
        volume = hounsfield(outcome.volume) if unit == "HU" else outcome.volume
        places = (folder, Path.cwd(), Path(gettempdir()))
        written_or_kept(out, lambda path: volume_writer(path, case.grid, unit)(volume), places)
        if outcome.sigma is not None:
            sigma = _sigma(outcome, unit)
            beside = sibling_path(out, ".sigma.nii.gz")
            written_or_kept(beside, lambda path: save_volume(path, sigma, case.grid), places)
        shown = review.CaseSheets(out.name, case.grid, 1.0, unit).about(volume, case.cameras)
        export.save_png(folder / "planes.png", review.scan(shown, volume))
        bar.phase("checking")
        left_out = settings.left_out and outcome.stopped is None
        table = {
            "name": settings.name,
            "method": method["name"],
            "volume": str(out),
            "unit": unit,
            "grid": {"shape": list(case.grid.shape), "spacing_mm": list(case.grid.spacing)},
            "views": {"count": len(case.cameras), "shape": list(case.cameras.shape)},
            **outcome.row(),
            "percentiles_1_99": _percentiles(outcome.volume, unit),
            "sanity_checks": sanity_checks.sanity_checks(
                case, method["name"], outcome, device, as_read
            ),
            "left_out": run_method.left_out(case, method, device) if left_out else None,
            **camera_row([cameras_of(alignment, {})]),
        }
        if estimate is not None and free:
            fit = correction.calibration_table(estimate, free)
            table["calibration"] = fit | {"cameras": str(sibling_path(out))}
        run_folder.write_results(folder, table)
    return table


def _sigma(outcome: "Outcome", unit: str) -> "Tensor":
    """The standard deviation of the volume in the unit."""
    from mvrecon.data.attenuation import hounsfield

    volume, sigma = outcome.volume, outcome.sigma
    assert sigma is not None
    if unit != "HU":
        return sigma
    # half of the difference, as the scale bends at water
    return (hounsfield(volume + sigma) - hounsfield(volume - sigma)) / 2


def _percentiles(volume: "Tensor", unit: str) -> list[float]:
    """The 1st and the 99th percentile of a volume in the unit; of a large one, of every n-th
    voxel.
    """
    from mvrecon.data.attenuation import hounsfield

    values = volume.flatten()[:: 1 + volume.numel() // 2**20].double()
    ends = values.quantile(values.new_tensor([0.01, 0.99]))
    return (hounsfield(ends) if unit == "HU" else ends).tolist()


def sibling_path(volume: Path, ending: str = ".cameras.json") -> Path:
    """The file beside a volume with its name and another ending, by default of a calibrated rig."""
    from mvrecon.data.volume_files import name_of

    return volume.with_name(name_of(volume) + ending)


def check_places(settings: ReconstructSettings, folder: Path) -> Path:
    """The path of the volume, which is writable and not an input.

    Raises:
        ValueError: an ending without a writer; an output file that is an input in the
            settings.
        OSError: a path that cannot be written.
    """
    from mvrecon.data.volume_files import check_ending

    out = Path(settings.out or folder / "volume.nii.gz").expanduser()
    check_ending(out)
    check_writable(out)
    written = [out, sibling_path(out, ".sigma.nii.gz"), *(folder / name for name in PRODUCTS)]
    if settings.calibrate:
        written.append(sibling_path(out))
    places = {path.resolve() for path in written}
    for keys, value in flatten({**vars(settings), "out": None}):
        if isinstance(value, str) and Path(value).expanduser().resolve() in places:
            raise ValueError(
                f"Expected an input that the run does not write, got {'.'.join(keys)}={value}; "
                f"choose another out or hydra.run.dir"
            )
    return out


def rig_of_scan(camera: dict[str, Any], overrides: Sequence[str]) -> dict[str, Any]:
    """A camera's settings without the defaults of a simulated rig: the numbers of views and of
    pixels, lengths and angles are null, those of the views on disk, unless the command line sets
    them. Of a cone beam, that is also its range of angles: parallel beams determine a slice over
    their default, 180 degrees.
    """
    if not any(override.startswith("camera=") for override in overrides):
        return camera
    given = {override.partition("=")[0].lstrip("+~") for override in overrides}

    def own(options: Mapping[str, Any], above: str) -> dict[str, Any]:
        kept = {}
        for name, value in options.items():
            key = f"{above}.{name}"
            if isinstance(value, Mapping) and key not in given:
                value = own(value, key)
            elif key not in given and (
                name == "pixels" or isinstance(value, int | float) and value
            ):
                value = None
            kept[name] = value
        return kept

    options = describe("camera", camera["name"]).options if "sdd" in camera else {}
    camera = own(camera, "camera")
    if ARC_OPTION in options and not {ARC_OPTION, "angles"} & set(camera):
        camera[ARC_OPTION] = None
    return camera


def scans_of(settings: dict[str, Any], folder: Path) -> dict[Path, ReconstructSettings]:
    """The settings of each scan by the folder of its run.

    A `*` in `views.path` stands for the names of several scans, and in every other path for the
    name of the same scan; their runs are `folder / name`.

    Raises:
        ValueError: more than one `*` in `views.path`, or an `out` without.
        FileNotFoundError: no scan has such a path.
    """
    pattern, out = settings["views"]["path"], settings["out"]
    before, star, after = pattern.partition("*")
    if not star or Path(pattern).exists():
        return {folder: ReconstructSettings(**settings)}
    paths = sorted(glob(f"{escape(before)}*{escape(after)}"))
    if "*" in after or not (out is None or "*" in out):
        raise ValueError(
            f"Expected one * in views.path, and a * in out, for the names of several scans, got "
            f"views.path={pattern} out={out}"
        )
    if not paths:
        raise FileNotFoundError(f"{pattern}: no scan has such a path")
    names = [path[len(before) : len(path) - len(after)] for path in paths]
    return {folder / name: ReconstructSettings(**_named(settings, name)) for name in names}


def _named(settings: Mapping[str, Any], name: str) -> dict[str, Any]:
    """Settings with a name in the place of the `*` of every path."""
    return with_paths(settings, ReconstructSettings, lambda path, _: path.replace("*", name))


def task(config: DictConfig) -> None:
    """One run of the app, of one or of several scans; a scan that fails does not end the others.

    Raises:
        KeyboardInterrupt: Ctrl-C, after the volume so far is written and reported.
        RuntimeError: scans that failed, of several.
    """
    folder = Path(HydraConfig.get().runtime.output_dir)
    with command_folder():
        settings = absolute_paths(to_plain(config), ReconstructSettings)
    settings["camera"] = rig_of_scan(settings["camera"], HydraConfig.get().overrides.task)
    scans, failed = scans_of(settings, folder), []
    for place, settings in scans.items():
        check_places(settings, place)
    for place, settings in scans.items():
        try:
            table = reconstruct(settings, place)
        except USER_ERRORS as error:
            if len(scans) == 1 or isinstance(error, PROGRAM_FAULTS):
                raise
            failed.append(place.name)
            sys.stderr.write(f"{place.name}: {sentence(error)}\n")
            continue
        report(table, place)
        if table["stopped"] is not None:
            raise KeyboardInterrupt
    if failed:
        raise RuntimeError(f"{len(failed)} of {len(scans)} scans failed: {', '.join(failed)}")


def report(table: dict[str, Any], folder: Path) -> None:
    """Print the results of a run; with `--quiet` its sanity checks alone."""
    from rich.console import Console

    from mvrecon.apps.progress import logger
    from mvrecon.data.attenuation import WATER
    from mvrecon.report.cameras import disturbed_cameras, little_weight

    lines, peak = [], table["peak_bytes"]
    if logger.isEnabledFor(logging.INFO):
        memory = "" if peak is None else f", {peak / 2**30:.2f} GiB at most"
        low, high = table["percentiles_1_99"]
        water = {"HU": " (water: 0)", "1/mm": f" (water: {WATER})"}.get(table["unit"], "")
        if fit := table.get("calibration"):
            lines.append(f"calibrate: {fit['words']}; {fit['cameras']}")
        lines += [
            f"{table['method']}: {table['seconds']:.2f} s{memory}, view NRMSE "
            f"{table['view_nrmse']:.3g}; {table['volume']}; pictures in {folder}",
            f"values: 1st to 99th percentile {low:.3g} to {high:.3g} {table['unit']}{water}",
            *disturbed_cameras(table.get("cameras")),
            *little_weight(table["camera_weights"]),
        ]
    if table["stopped"] is not None:
        lines.append(f"Ctrl-C: the volume is that of iteration {table['stopped']}")
    lines += [f"sanity check: {words}" for words in table["sanity_checks"]]
    for line in lines:
        Console(markup=False, highlight=False).print(line, soft_wrap=True)


def main() -> None:
    """Entry point of `mvrecon-reconstruct`."""
    from mvrecon.apps.progress import LEVELS, logger

    flags = [argument for argument in sys.argv[1:] if argument in LEVELS]
    logger.setLevel(LEVELS[flags[-1]] if flags else logging.INFO)
    sys.argv[1:] = [argument for argument in sys.argv[1:] if argument not in flags]
    launch(task, "reconstruct")


if __name__ == "__main__":
    main()
