"""`mvrecon-reconstruct`: a volume from measured views, with its pictures, time and memory."""

from pathlib import Path
from typing import Any

from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig

from mvrecon.config import launch, to_plain
from mvrecon.config.plugins import import_plugins

UNITS = ("1/mm", "HU")


def reconstruct(settings: dict[str, Any], folder: Path) -> dict[str, Any]:
    """Reconstruct a measured scan; returns what `results.json` then holds.

    The folder gets `config.yaml`, `versions.txt`, `rig.json`, `rig.png`, `planes.png`,
    `results.json` and, unless `out` names another file, the volume; with `correct=align` also
    `cameras.png`.

    Raises:
        RuntimeError: another process is at work in the folder.
        ValueError: the folder's run has other settings; views, rig, grid or method do not fit.
    """
    import_plugins(settings["plugins"])
    from mvrecon.cameras import files
    from mvrecon.data.attenuation import hounsfield
    from mvrecon.data.volume_files import check_ending, save_volume
    from mvrecon.engine import correction, export, run_folder, scan, solve, wrong_cameras
    from mvrecon.engine.evaluation import device_of
    from mvrecon.viz import cameras, montage, rig

    if settings["unit"] not in UNITS:
        raise ValueError(f"Expected the unit 1/mm or HU, got {settings['unit']!r}")
    out = Path(settings["out"] or folder / "volume.nii.gz").expanduser()
    check_ending(out)
    case = scan.open_scan(settings)
    solve.check(settings)  # what does not fit is told before the folder is anybody's
    correction.check(settings)
    device = device_of(settings["device"])
    with run_folder.taken(folder, settings):
        case, alignment = correction.corrected_scan(case, settings, device)
        if alignment is not None:
            image = cameras.alignments(alignment.shift_px[0], alignment.gain[0])
            export.save_png(folder / "cameras.png", image)
        files.save(case.cameras, folder / "rig.json")
        export.save_png(folder / "rig.png", rig.picture(case.cameras, case.grid))
        outcome = solve.solve(case, settings, device)
        volume = outcome.volume
        spacing = case.grid.spacing
        export.save_png(folder / "planes.png", montage.slices(volume, spacing))
        save_volume(out, hounsfield(volume) if settings["unit"] == "HU" else volume, case.grid)
        table = {
            "name": settings["name"],
            "method": settings["reconstructor"]["name"],
            "volume": str(out),
            "unit": settings["unit"],
            "grid": {"shape": list(case.grid.shape), "spacing_mm": list(spacing)},
            "views": {"count": len(case.cameras), "shape": list(case.cameras.shape)},
            "seconds": outcome.seconds,
            "peak_bytes": outcome.peak_bytes,
            "view_nrmse": solve.residual(case, volume),
            "residuals": outcome.residuals,
            "chosen": outcome.chosen,
            "left_out": solve.left_out(case, settings, device) if settings["left_out"] else None,
            **wrong_cameras.camera_row([wrong_cameras.cameras_of(alignment, {})]),
        }
        run_folder.write_results(folder, table)
    return table


def task(config: DictConfig) -> None:
    """One run of the app."""
    from rich.console import Console

    from mvrecon.engine.run_folder import anchored
    from mvrecon.engine.wrong_cameras import sentences

    folder = Path(HydraConfig.get().runtime.output_dir)
    table = reconstruct(anchored(to_plain(config)), folder)
    peak = table["peak_bytes"]
    memory = "" if peak is None else f", {peak / 2**30:.2f} GiB at most"
    Console(markup=False, highlight=False).print(
        f"{table['method']}: {table['seconds']:.2f} s{memory}, view NRMSE "
        f"{table['view_nrmse']:.3g}; {table['volume']}; pictures in {folder}",
        *sentences(table.get("cameras")),
        sep="\n",
        soft_wrap=True,
    )


def main() -> None:
    """Entry point of `mvrecon-reconstruct`."""
    launch(task, "reconstruct")


if __name__ == "__main__":
    main()
