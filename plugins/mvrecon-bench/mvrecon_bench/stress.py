"""`mvrecon-stress`: run the stress plan on operators, cameras, scenes, heads or methods, including
those of plugins.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig

from mvrecon.apps.config import launch, to_plain
from mvrecon.core.quantities import PositiveFloat
from mvrecon.core.registry import import_plugins


@dataclass
class StressSettings:
    """Settings of `mvrecon-stress`."""

    parts: str | Sequence[Any]
    cases: Sequence[int] | None
    device: str
    dtypes: Sequence[str]
    limit_s: PositiveFloat
    out: Path
    plugins: str | Sequence[str] | None


def stress(settings: dict[str, Any], folder: Path) -> list[dict[str, Any]]:
    """Run or resume the tests described by `settings`, and return all verdicts.

    The folder contains `results.csv`, `verdicts.json`, `table.md`, `config.yaml`, `versions.txt`,
    and all of it on TensorBoard.

    Raises:
        RuntimeError: another process uses the folder.
        ValueError, FileExistsError: the folder is another run's.
        PermissionError: it contains anything but files and folders.
    """
    import_plugins(settings["plugins"])
    from mvrecon.core.files.atomic import claimed
    from mvrecon.core.machine import device_of
    from mvrecon.training import run_folder
    from mvrecon_bench.benchmarks import runner
    from mvrecon_bench.stresses.stress import Stress

    device = device_of(settings["device"])
    chosen = (settings["parts"], settings["cases"] or (), device, settings["dtypes"])
    plan = Stress(*chosen, settings["limit_s"])
    runner.check(plan, folder)
    with claimed(folder):
        run_folder.start(folder, settings)
        return runner.run(plan, folder)


def task(config: DictConfig) -> None:
    """Run the app.

    Raises:
        SystemExit: a case failed.
    """
    from rich.console import Console

    from mvrecon_bench.stresses.stress import counts
    from mvrecon_bench.stresses.verdict import FAIL

    folder = Path(HydraConfig.get().runtime.output_dir)
    rows = stress(to_plain(config), folder)
    tell = Console(markup=False, highlight=False).print
    verdicts = counts(rows)
    for row in rows:
        if row["verdict"] == FAIL:
            tell(
                f"FAIL {row['number']:.0f} {row['case']}, {row['part']} {row['dtype']}: "
                f"{row.get('measured')} > "
                f"{row['tolerance']:g} {row.get('note', '')}",
                soft_wrap=True,
            )
    tell(
        f"{', '.join(f'{count} {verdict}' for verdict, count in verdicts.items())}; all is in "
        f"{folder}",
        soft_wrap=True,
    )
    if verdicts[FAIL]:
        raise SystemExit(1)


def main() -> None:
    """Entry point of `mvrecon-stress`."""
    launch(task, "stress", StressSettings)


if __name__ == "__main__":
    main()
