"""`mvrecon-reconstruct`: reconstructs measured views; reports pictures, time and memory."""

import logging
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields, replace
from functools import partial
from glob import escape, glob
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig

from mvrecon.apps import scan_file
from mvrecon.apps.config import launch, record_of
from mvrecon.apps.config.errors import PROGRAM_FAULTS, USER_ERRORS, one_line, sentence
from mvrecon.apps.config.guard import as_typed
from mvrecon.apps.settings import ReconstructSettings, complete
from mvrecon.core.options import with_paths
from mvrecon.core.parts import CameraPart, describe
from mvrecon.core.registry import import_plugins

if TYPE_CHECKING:
    from mvrecon.apps.correction import Corrections
    from mvrecon.apps.output import Output
    from mvrecon.apps.progress import Bar
    from mvrecon.apps.run_method import Method
    from mvrecon.apps.scan import Scan
    from mvrecon.geometry.cameras.camera import Cameras
    from mvrecon.geometry.grid import Grid

#: The option of rigs on a circle whose default is that of a simulated one.
ARC_OPTION = "arc_degrees"
#: Ends the warning of a scan that sees little of the grid.
SMALLER_GRID_HINT = (
    "without grid.* the grid is what all views see, or of a half fan what they measure together, "
    "and with grid.seen_by=0.5 alone what half of them see"
)
#: Ends it where the grid is what a share of the views see.
LARGER_SHARE_HINT = "a larger grid.seen_by chooses a smaller grid"


def run_reconstruction(settings: ReconstructSettings, folder: Path) -> dict[str, Any]:
    """Build what settings describe, and reconstruct it in a run folder, see `reconstruct`; returns
    the contents of `results.json`.

    A failed run removes its files, so that the folder can be used again, except a computed volume.

    Raises:
        RuntimeError: another process uses the folder.
        ValueError: the folder's run has other settings; an input would be written to; views, rig,
            grid, method or the volume's file do not fit; and as `reconstruct`.

    Warns:
        UserWarning: the views see little of the grid.
    """
    import_plugins(settings.plugins)
    from mvrecon.apps.correction import Corrections
    from mvrecon.apps.output import PRODUCTS, Output
    from mvrecon.apps.progress import Bar
    from mvrecon.apps.run_method import Choose, Method
    from mvrecon.apps.scan import GridOfScan, grid_of
    from mvrecon.core.machine import device_of
    from mvrecon.geometry.cameras.coverage import check_coverage
    from mvrecon.methods.calibration.self_alignment import self_aligned
    from mvrecon.training.run_folder import run_lock

    output = Output.of(settings, folder)
    choose = None if settings.choose is None else Choose(**settings.choose)
    method = Method.of(settings.method, settings.stop["sigma"], choose)
    align = None if settings.correct is None else partial(self_aligned, **settings.correct)
    choose_grid = grid_of(GridOfScan(**settings.grid), method.module)
    corrections = Corrections(settings.calibrate or (), choose_grid, align, settings.self_calibrate)
    others = settings.joint or ()
    if any((settings.scatter, *(other["scatter"] for other in others))):
        method.check_scatter()
        if corrections.free or align or method.choose or settings.left_out:
            raise ValueError(
                "Expected scatter without calibrate, correct, choose and left_out, which have none"
            )
    if settings.factors is not None and corrections.free:
        raise ValueError("Expected factors without calibrate, which fits views without them")
    if others and (corrections.free or align or method.declares("data_kind") != "counts"):
        raise ValueError(
            f"Expected joint with a method of counts, such as osem, and without calibrate and "
            f"correct, got {method.name}"
        )
    if settings.estimate_shifts and not others:
        raise ValueError("Expected joint=[...], the further frames, for estimate_shifts=true")
    scan = read_scan(settings, choose_grid)
    output = output.for_scan(scan)
    corrections.check(scan)
    device = device_of(settings.device)
    by_share = settings.grid.get("seen_by") is not None
    check_coverage(scan.cameras, scan.grid, LARGER_SHARE_HINT if by_share else SMALLER_GRID_HINT)
    with run_lock(folder, vars(settings), products=PRODUCTS), Bar() as bar:
        return reconstruct(scan, method, output, corrections, settings, device, bar)


def read_scan(
    settings: ReconstructSettings, choose_grid: "Callable[[Cameras], Grid] | None" = None
) -> "Scan":
    """Open the scan of settings; raises as `open_scan`.

    Args:
        settings: settings of a reconstruction.
        choose_grid: f(cameras) -> the grid; None: by the settings alone, without a trained network.
    """
    from mvrecon.apps.scan import GridOfScan, open_scan
    from mvrecon.data.projections.views import Measured

    grid = choose_grid or GridOfScan(**settings.grid).voxels
    parts = ("camera", "projector", "scatter", "factors")

    def opened(options: Mapping[str, Any], grid: "Callable[[Cameras], Grid]") -> "Scan":
        others = {name: options[name] for name in parts}
        return open_scan(Measured(**options["views"]), grid=grid, **others)

    scan = opened(vars(settings), grid)
    if not settings.joint:
        return scan
    from mvrecon.apps.joint import joined

    return joined([scan, *(opened(other, lambda _: scan.grid) for other in settings.joint)])


def reconstruct(
    scan: "Scan",
    method: "Method",
    output: "Output",
    corrections: "Corrections",
    settings: ReconstructSettings,
    device: str,
    bar: "Bar",
) -> dict[str, Any]:
    """Reconstruct a measured scan; returns the contents of `results.json`.

    The folder gets `config.yaml`, `versions.txt`, `rig.json`, `rig.png`, `planes.png`,
    `results.json` and, unless `out` names another file, the volume; with `correct=align` also
    `cameras.png`. Beside the volume, `calibrate` writes the rig, see `save_calibration`, and a
    network that estimates the standard deviation of its error `<volume>.sigma.nii.gz`, in the
    volume's unit. Ctrl-C ends an iterative method with its last iterate, number `stopped`.

    Args:
        scan: the views as measured.
        method: the method that reconstructs them.
        output: files to write.
        corrections: corrections before the reconstruction.
        settings: settings of the run; `left_out`: also predict each view from all others, by one
            more reconstruction each.
        device: device to compute on.
        bar: the run's progress bar.

    Raises:
        OSError: the volume cannot be written, as on a disk without space for it; a computed one is
            kept elsewhere, and the message says where.
        ValueError: what corrections and method raise.
        KeyboardInterrupt: Ctrl-C before the first iterate, or in a method that does not iterate.
    """
    from mvrecon.apps import correction, joint, run_method, sanity_checks
    from mvrecon.geometry.cameras import files
    from mvrecon.report.cameras import camera_row, cameras_of
    from mvrecon.report.viz import images, review, rig
    from mvrecon.training import run_folder

    as_read, folder, free = scan.measured, output.folder, corrections.free
    nominal, alignment, fit = scan, None, None
    if free:
        scan, estimate = correction.calibrate(scan, free, device, bar)
        scan = replace(scan, grid=corrections.grid(scan.cameras))
        fit = correction.calibration_table(estimate, free)
    fitted = scan.cameras
    shifts = None
    if settings.estimate_shifts:
        bar.phase("shifts")
        scan, shifts = joint.with_shifts(scan, device)
    scan, polynomial = correction.linearised(scan, device, bar)
    if corrections.align is not None:
        bar.phase("aligning")
        scan, alignment = correction.corrected_scan(
            scan, corrections.align, corrections.self_calibrate, device
        )
        image = review.alignments(alignment.shift_px[0], alignment.gain[0])
        images.save_png(folder / "cameras.png", image)
    files.save(scan.cameras, folder / "rig.json")
    images.save_png(folder / "rig.png", rig.picture(scan.cameras, scan.grid))
    outcome = run_method.run_method(scan, method, device, bar)
    bar.phase("writing")
    output.write(outcome, scan.grid)
    if fit is not None:  # files of an earlier run stay until this one has its volume
        fit |= save_calibration(nominal, fitted, free, settings.grid, output)
    volume = output.in_unit(outcome.volume)
    title = f"{output.volume.name}: {method.name}, {len(scan.cameras)} views"
    sheets = review.CaseSheets(title, scan.grid, 1.0, output.unit)
    picture = review.scan(sheets.about(volume, scan.cameras), volume)
    images.save_png(folder / "planes.png", picture)
    bar.phase("checking")
    left_out = settings.left_out and outcome.stopped is None
    table = {
        "name": output.name,
        "method": method.name,
        "volume": str(output.volume),
        "unit": output.unit,
        "grid": {"shape": list(scan.grid.shape), "spacing_mm": list(scan.grid.spacing)},
        "views": {"count": len(scan.cameras), "shape": list(scan.cameras.shape)},
        **outcome.row(),
        "percentiles_1_99": output.percentiles(outcome.volume),
        **run_method.emission(scan, outcome.volume, device),
        "sanity_checks": sanity_checks.sanity_checks(scan, method, outcome, device, as_read),
        "left_out": run_method.left_out(scan, method, device) if left_out else None,
        **camera_row([cameras_of(alignment, {})]),
    }
    if fit is not None:
        table["calibration"] = fit
    if shifts is not None:
        found = {"shift_mm": shifts.shift_mm.tolist(), "sigma_mm": shifts.sigma_mm.tolist()}
        table["shifts"] = {**found, "settled": shifts.settled}
    if polynomial is not None:
        table["linearisation"] = polynomial._asdict()
    run_folder.write_results(folder, table)
    return table


def save_calibration(
    nominal: "Scan",
    fitted: "Cameras",
    free: Sequence[str],
    grid: Mapping[str, Any],
    output: "Output",
) -> dict[str, str | None]:
    """Write a calibrated rig as `<volume>.cameras.json`, for all views on disk, and the scan with
    this rig as `<volume>.scan.yaml`; returns both files.

    No file of a scan holds gains, or shifts of views that were left out (`views.every`): there is
    no `scan.yaml` then, and the rig is that of the other views alone.

    Args:
        nominal: the scan before the calibration.
        fitted: the scan's cameras after it.
        free: parameters that were fitted.
        grid: settings of the scan's grid.
        output: files to write.

    Raises:
        ValueError: views in memory.
    """
    from mvrecon.apps.correction import rig_on_disk
    from mvrecon.apps.output import RIG_ENDING, SCAN_ENDING
    from mvrecon.data.projections.views import MeasuredViews
    from mvrecon.geometry.cameras import files

    measured, rig = nominal.measured, nominal.rig
    if rig is None or not isinstance(measured, MeasuredViews):
        raise ValueError("Expected a scan of views on disk, got views in memory")
    options = measured.options
    rig_file, scan = output.beside(RIG_ENDING), output.beside(SCAN_ENDING)
    partial_rig = "shifts" in free and options.every > 1
    on_disk = rig_on_disk(measured, rig, nominal.cameras, fitted)
    files.save(fitted if partial_rig else on_disk, rig_file)
    if partial_rig or "gains" in free:
        scan.unlink(missing_ok=True)  # of an earlier run, and no longer of this rig
        return {"cameras": str(rig_file), "scan": None}
    views = {
        one.name: value
        for one in fields(options)
        if (value := getattr(options, one.name)) != one.default
    }
    description = {
        "views": views,
        "camera": {"name": "from_file", "path": str(rig_file)},
        "projector": nominal.projector,
        "grid": grid or None,
    }
    scan_file.save(scan, description)
    return {"cameras": str(rig_file), "scan": str(scan)}


def rig_of_scan(camera: CameraPart, overrides: Sequence[str]) -> CameraPart:
    """A camera's settings without the defaults of a simulated rig: the numbers of views and of
    pixels, lengths and angles are null, those of the views on disk, unless the command line sets
    them. Of a cone beam, that is also its range of angles: parallel beams determine a slice over
    their default, 180 degrees.
    """
    if not any(override.startswith("camera=") for override in overrides):
        return camera
    given = {override.partition("=")[0].lstrip("+~") for override in overrides}

    def own(options: CameraPart, above: str) -> CameraPart:
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
        camera = {**camera, ARC_OPTION: None}
    return camera


def scans_of(settings: ReconstructSettings, folder: Path) -> dict[Path, ReconstructSettings]:
    """The settings of each scan by the folder of its run.

    A `*` in `views.path` stands for the names of several scans, and in every other path for the
    name of the same scan; their runs are `folder / name`.

    Raises:
        ValueError: more than one `*` in `views.path`, or an `out` without.
        FileNotFoundError: no scan has such a path.
    """
    pattern, out = settings.views["path"], settings.out
    before, star, after = pattern.partition("*")
    if not star or Path(pattern).exists():
        return {folder: settings}
    paths = sorted(glob(f"{escape(before)}*{escape(after)}"))
    if "*" in after or not (out is None or "*" in str(out)):
        raise ValueError(
            f"Expected one * in views.path, and a * in out, for the names of several scans, got "
            f"views.path={pattern} out={out}"
        )
    if not paths:
        raise FileNotFoundError(f"{pattern}: no scan has such a path")
    names = [path[len(before) : len(path) - len(after)] for path in paths]
    return {folder / name: _named(settings, name) for name in names}


def _named(settings: ReconstructSettings, name: str) -> ReconstructSettings:
    """Settings with a name in the place of the `*` of every path."""
    record = ReconstructSettings
    return record(**with_paths(vars(settings), record, lambda path, _: path.replace("*", name)))


def task(config: DictConfig) -> None:
    """One run of the app, of one or of several scans; a scan that fails does not end the others.

    Raises:
        KeyboardInterrupt: Ctrl-C, after the volume so far is written and reported.
        RuntimeError: scans that failed, of several.
    """
    from mvrecon.apps.output import Output

    folder = Path(HydraConfig.get().runtime.output_dir)
    settings = record_of(config, ReconstructSettings)
    camera = rig_of_scan(settings.camera, as_typed(HydraConfig.get()))
    scans, failed = scans_of(complete(replace(settings, camera=camera)), folder), []
    for place, settings in scans.items():
        Output.of(settings, place)
    for place, settings in scans.items():
        try:
            table = run_reconstruction(settings, place)
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

    lines = _figures(table, folder) if logger.isEnabledFor(logging.INFO) else []
    if table["stopped"] is not None:
        lines.append(f"stopped: the volume is that of iteration {table['stopped']}")
    lines += [f"sanity check: {words}" for words in table["sanity_checks"]]
    for line in lines:
        Console(markup=False, highlight=False).print(line, soft_wrap=True)


def _figures(table: dict[str, Any], folder: Path) -> list[str]:
    """The results of a run in lines of text: estimates, time and residual, values, cameras."""
    from mvrecon.apps.scan import EMISSION
    from mvrecon.data.attenuation import CONCENTRATION, WATER
    from mvrecon.report.cameras import disturbed_cameras, little_weight

    lines, peak = [], table["peak_bytes"]
    memory = "" if peak is None else f", {peak / 2**30:.2f} GiB at most"
    low, high = table["percentiles_1_99"]
    about = {
        "HU": " (water: 0)",
        "1/mm": f" (water: {WATER})",
        EMISSION: " (relative; factors with branching give kBq/ml)",
        CONCENTRATION: f"; {table.get('total_mbq') or 0:.4g} MBq in the grid",
    }.get(table["unit"], "")
    if fit := table.get("calibration"):
        lines.append(f"calibrate: {fit['words']}; {fit['scan'] or fit['cameras']}")
    if shifts := table.get("shifts"):
        pairs = zip(shifts["shift_mm"], shifts["sigma_mm"], strict=True)
        for number, (shift, sigma) in [*enumerate(pairs)][1:]:
            axes = zip("xyz", shift, sigma, strict=True)
            words = ", ".join(f"{axis} {t:+.2f} +- {s:.2f}" for axis, t, s in axes)
            lines.append(f"shift of joint.{number - 1}: {words} mm")
    if polynomial := table.get("linearisation"):
        numbers = ",".join(f"{c:.6g}" for c in polynomial["coefficients"])
        lines.append(
            f"views.linearise=[{numbers}]: fitted to the views, for other scans of this beam; "
            f"the object is {polynomial['value']:.4g}/mm, {polynomial['residual']:.2%} of its "
            f"line integrals are left"
        )
    compared, count = table["compared_views"], table["views"]["count"]
    of = "" if compared in (None, count) else f" of {compared} of {count} views"
    lines += [
        f"{table['method']}: {table['seconds']:.2f} s{memory}, view NRMSE "
        f"{table['view_nrmse']:.3g}{of}; {table['volume']}; pictures in {folder}",
        f"values: 1st to 99th percentile {low:.3g} to {high:.3g} {table['unit']}{about}",
    ]
    if sensitivity := table.get("sensitivity_cps_per_mbq"):
        lines.append(
            f"sensitivity: {sensitivity:.4g} cps/MBq at the centre of the grid, all views at "
            f"once, one photon per decay"
        )
    return [
        *lines,
        *disturbed_cameras(table.get("cameras")),
        *little_weight(table["camera_weights"]),
    ]


def main() -> None:
    """Entry point of `mvrecon-reconstruct`."""
    from mvrecon.apps.progress import LEVELS, logger

    flags = [argument for argument in sys.argv[1:] if argument in LEVELS]
    logger.setLevel(LEVELS[flags[-1]] if flags else logging.INFO)
    arguments = [argument for argument in sys.argv[1:] if argument not in flags]
    with one_line("mvrecon-reconstruct"):
        sys.argv[1:] = scan_file.expanded(arguments)
    launch(task, "reconstruct")


if __name__ == "__main__":
    main()
