"""`mvrecon-events`: generate random events, each with truth, ideal views and counts."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any

from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig

from mvrecon.apps.config import launch, record_of
from mvrecon.apps.settings import Measurement
from mvrecon.core.registry import import_plugins
from mvrecon.core.signatures import OptionsOf


@dataclass
class EventsSettings(Measurement):
    """Settings of `mvrecon-events`.

    Args:
        events: The number of events (count), of those in a file (shard), of processes (workers) and
            of angles of a sinogram over the full circle; first is the index of the first event in
            its series, totals the least and the greatest expected counts. docs/events.md
            describes all.
    """

    events: Annotated[Mapping[str, Any], OptionsOf("mvrecon_spect.events.making:EventSettings")] = (
        field(default_factory=dict)
    )


def simulate_events(settings: EventsSettings, folder: Path) -> list[Path]:
    """Generate a data set of events in `<folder>/events` and return its files.

    The folder also contains `config.yaml`, `versions.txt` and the rig as `rig.json`. An interrupted
    run resumes with the missing files; the number of workers may change.

    Raises:
        RuntimeError: another process uses the folder.
        ValueError: the folder's run has other settings, or a file is damaged or has other settings.
        OSError: insufficient disk space.

    Warns:
        UserWarning: the rig sees little of the grid.
    """
    import_plugins(settings.plugins)
    from mvrecon.geometry.cameras import files
    from mvrecon.geometry.cameras.coverage import check_coverage, fitted
    from mvrecon.training import run_folder
    from mvrecon_spect.events.making import EventMaker, write_events

    settings = replace(settings, camera=fitted(settings.camera, settings.grid))
    maker = EventMaker.of(vars(settings))
    check_coverage(maker.cameras, maker.grid)
    events = {key: value for key, value in settings.events.items() if key != "workers"}
    with run_folder.run_lock(folder, {**vars(settings), "events": events}):
        files.save(maker.cameras, folder / run_folder.RIG)
        return write_events(folder / "events", maker, vars(settings))


def task(config: DictConfig) -> None:
    """Run the app."""
    from rich.console import Console

    folder = Path(HydraConfig.get().runtime.output_dir)
    paths = simulate_events(record_of(config, EventsSettings), folder)
    Console(markup=False, highlight=False).print(
        f"{len(paths)} file(s) of events written to {folder}", soft_wrap=True
    )


def main() -> None:
    """Entry point of `mvrecon-events`."""
    launch(task, "events", EventsSettings)


if __name__ == "__main__":
    main()
