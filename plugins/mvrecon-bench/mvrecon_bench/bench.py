"""`mvrecon-bench`: run time and error of projectors and methods, and their scaling with the amount
of work.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig

from mvrecon.apps.config import launch, to_plain
from mvrecon.core.registry import Registry, import_plugins

#: The benchmarks by name: `bench=<name>` reads its options from `conf/bench/<name>.yaml`.
BENCHES = Registry(
    "bench",
    operators="mvrecon_bench.benchmarks.operators:Operators",
    methods="mvrecon_bench.benchmarks.methods:Methods",
    scaling="mvrecon_bench.benchmarks.scaling:Scaling",
    precision="mvrecon_bench.benchmarks.precision:Precision",
    emission="mvrecon_bench.benchmarks.emission:Emission",
    skip="mvrecon_bench.benchmarks.skip:Skip",
)


@dataclass
class BenchSettings:
    """Settings of `mvrecon-bench`.

    Args:
        out: Folder of the table, the plot and config.yaml.
        plugins: Modules to import first, which register parts.
    """

    bench: Mapping[str, Any]
    out: Path
    plugins: str | Sequence[str] | None


def task(config: DictConfig) -> None:
    """Run the app; see `mvrecon_bench.runner.run` for the folder."""
    from rich.console import Console

    folder, settings = Path(HydraConfig.get().runtime.output_dir), to_plain(config)
    import_plugins(settings["plugins"])
    from mvrecon_bench.runner import run

    rows = run(BENCHES.from_config(settings["bench"]), folder, settings)
    skipped = sum(row["status"] != "ok" for row in rows)
    text = f"{len(rows)} rows, {skipped} of them skipped; table and plot are in {folder}"
    Console(markup=False, highlight=False).print(text, soft_wrap=True)


def main() -> None:
    """Entry point of `mvrecon-bench`."""
    launch(task, "bench", BenchSettings)


if __name__ == "__main__":
    main()
