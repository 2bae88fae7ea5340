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
    """Settings of `mvrecon-stress`.

    Args:
        parts: all, or the parts that are tested: names such as [drr], parts with options such as
            [{name: drr, method: siddon}] or [{kind: camera, name: dcspect80}]; [mvrecon] tests
            what belongs to no part.
        cases: Numbers of the cases that are run; null: all.
        device: Where it computes: cpu, gpu or auto.
        dtypes: Data types of volumes and views: float64, float32, bfloat16, float16.
        limit_s: Time limit of a case in seconds.
        out: Folder of the table.
        plugins: Modules to import first, which register parts.
    """

    parts: str | Sequence[Any]
    cases: Sequence[int] | None
    device: str
    dtypes: Sequence[str]
    limit_s: PositiveFloat
    out: Path
    plugins: str | Sequence[str] | None


def task(config: DictConfig) -> None:
    """Run the app; see `mvrecon_bench.runner.run` for the folder.

    Raises:
        SystemExit: a case failed.
    """
    from rich.console import Console

    folder, settings = Path(HydraConfig.get().runtime.output_dir), to_plain(config)
    import_plugins(settings["plugins"])
    from mvrecon.core.machine import device_of
    from mvrecon_bench import runner
    from mvrecon_bench.stresses.plan import Stress, counts
    from mvrecon_bench.stresses.verdict import FAIL

    chosen = {name: settings[name] for name in ("parts", "dtypes", "limit_s")}
    device, numbers = device_of(settings["device"]), settings["cases"] or ()
    rows = runner.run(Stress(**chosen, cases=numbers, device=device), folder, settings)
    tell, verdicts = Console(markup=False, highlight=False).print, counts(rows)
    for row in rows:
        if row["verdict"] == FAIL:
            found = f"{row.get('measured')} > {row['tolerance']:g} {row.get('note', '')}"
            text = f"FAIL {row['number']:.0f} {row['case']}, {row['part']} {row['dtype']}: {found}"
            tell(text, soft_wrap=True)
    listed = ", ".join(f"{count} {verdict}" for verdict, count in verdicts.items())
    tell(f"{listed}; all is in {folder}", soft_wrap=True)
    if verdicts[FAIL]:
        raise SystemExit(1)


def main() -> None:
    """Entry point of `mvrecon-stress`."""
    launch(task, "stress", StressSettings)


if __name__ == "__main__":
    main()
