"""Pinhole SPECT: agreement of the operators with the CPU, their time, and training steps. Takes
about a minute.

    python -m mvrecon_bench.gpu.pinholes --out FOLDER [--device cuda] [SETTING...]
"""

from typing import Any

import torch
from lightning.fabric.utilities import move_data_to_device

from mvrecon.apps.config import compose
from mvrecon.data.dataset import Batch
from mvrecon.training.fit import build_data, build_module
from mvrecon.training.module import build_projector
from mvrecon.training.settings import TrainSettings
from mvrecon_bench.gpu.check import apart
from mvrecon_bench.gpu.learn import profiled, training_step
from mvrecon_bench.gpu.measuring import Results, on_device, options_of
from mvrecon_bench.measure import latency

EXPERIMENT = "dcspect_faults_80"
#: Options of the projector "spect".
OPERATORS: dict[str, dict[str, Any]] = {
    "ideal pinholes": {},
    "attenuation": {"mu": "case"},
    "blur": {"blur": True},
    "blur and attenuation": {"blur": True, "mu": "case"},
}
METHODS = ("cross_view_counts", "world_unet_counts")


@torch.no_grad()
def agreement(
    settings: TrainSettings, options: dict[str, Any], batch: Batch, device: str
) -> dict[str, Any]:
    """Maximum differences from the CPU relative to the maximum value, and milliseconds, for one
    case.
    """
    one = {k: v[:1] for k, v in batch.items() if torch.is_tensor(v)}
    place = settings.grid, settings.camera, {"name": "spect", **options}
    C, there = build_projector(*place).for_case(one), move_data_to_device(one, device)
    A = build_projector(*place).to(device).for_case(there)
    x, y = there["volume"], there["views"]
    return {
        "forward": apart(A(x), C(one["volume"])),
        "adjoint": apart(A.T(y), C.T(one["views"])),
        "forward_ms": latency(lambda: A(x), device, 9),
        "adjoint_ms": latency(lambda: A.T(y), device, 9),
    }


def steps(
    settings: TrainSettings, batch: Batch, data_range: float, count: int, device: str
) -> dict[str, Any]:
    """The slowest kernels of a training step, and its time."""
    torch.manual_seed(0)
    module = build_module(settings, settings.method, data_range).to(device)
    there = move_data_to_device(batch, device)
    return profiled(training_step(module, lambda number: there, half=False), count, device)


def main() -> None:
    """Entry point."""
    options = options_of(__doc__, settings=True, profile=3)
    device = on_device(options.device)
    results, few = Results(options.out, "pinholes"), "data.sizes={train: 2, val: 1, test: 1}"
    settings = {
        method: TrainSettings(
            **compose(f"experiment={EXPERIMENT}", f"method={method}", few, *options.settings)
        )
        for method in METHODS
    }
    first = settings[METHODS[0]]
    data = build_data(first)
    data.setup("fit")
    batch = next(iter(data.train_dataloader()))

    def measure(operator: str) -> None:
        results.row(operator=operator, **agreement(first, OPERATORS[operator], batch, device))

    for name in OPERATORS:
        results.attempt(name, measure, name)
    for method, of in settings.items():
        results.attempt(method, steps, of, batch, data.data_range, options.profile, device)


if __name__ == "__main__":
    main()
