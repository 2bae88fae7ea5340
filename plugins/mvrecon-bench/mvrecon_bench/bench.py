"""`mvrecon-bench`: run time and error of projectors, and their scaling with the amount of work."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig

from mvrecon.apps.config import launch, to_plain
from mvrecon.core.registry import import_plugins


@dataclass
class BenchSettings:
    """Settings of `mvrecon-bench`."""

    bench: Mapping[str, Any]
    out: Path
    plugins: str | Sequence[str] | None


def bench(settings: dict[str, Any], folder: Path) -> list[dict[str, Any]]:
    """Run or resume the benchmark described by `settings`, and return all rows.

    The folder contains `results.csv`, `table.md`, `targets.md`, a plot, `config.yaml`,
    `versions.txt`, and all of it on TensorBoard.

    Raises:
        RuntimeError: another process uses the folder.
        ValueError, FileExistsError: the folder is another run's.
        PermissionError: it contains anything but files and folders.
    """
    import_plugins(settings["plugins"])
    from mvrecon.core.files.atomic import claimed
    from mvrecon.training import run_folder
    from mvrecon_bench.benchmarks import runner
    from mvrecon_bench.benchmarks.kinds import BENCHES

    kind = BENCHES.from_config(settings["bench"])
    runner.check(kind, folder)
    with claimed(folder):
        run_folder.start(folder, settings)
        return runner.run(kind, folder)


def task(config: DictConfig) -> None:
    """Run the app."""
    from rich.console import Console

    folder = Path(HydraConfig.get().runtime.output_dir)
    rows = bench(to_plain(config), folder)
    skipped = sum(row["status"] != "ok" for row in rows)
    tell = Console(markup=False, highlight=False).print
    tell(
        f"{len(rows)} rows, {skipped} of them skipped; table, plot and targets are in {folder}",
        soft_wrap=True,
    )


def main() -> None:
    """Entry point of `mvrecon-bench`."""
    launch(task, "bench", BenchSettings)


if __name__ == "__main__":
    main()
