"""Pinhole SPECT: agreement of the operators with the CPU, their time, and training steps. Takes
about a minute.

    python -m mvrecon_bench.gpu.pinholes --out FOLDER [--device cuda] [SETTING...]
"""

import argparse
from pathlib import Path
from typing import Any

import torch
from lightning.fabric.utilities import move_data_to_device

from mvrecon.apps.config import compose
from mvrecon.operators.cases import operator_for
from mvrecon.training.fit import build_data, build_module
from mvrecon.training.module import build_projector
from mvrecon.training.settings import TrainSettings
from mvrecon_bench.gpu.learn import profiled
from mvrecon_bench.gpu.measuring import Results, latency, on_device

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
    settings: TrainSettings, options: dict[str, Any], batch: dict[str, Any], device: str
) -> dict[str, Any]:
    """Maximum differences from the CPU relative to the maximum value, and milliseconds, for one
    case.
    """
    one = {k: v[:1] for k, v in batch.items() if torch.is_tensor(v)}
    place = settings.grid, settings.camera, {"name": "spect", **options}
    C, there = operator_for(build_projector(*place), one), move_data_to_device(one, device)
    A = operator_for(build_projector(*place).to(device), there)
    x, y = there["volume"], there["views"]
    views, volume = C(one["volume"]), C.T(one["views"])
    return {
        "forward": float((A(x).cpu() - views).abs().max() / views.abs().max()),
        "adjoint": float((A.T(y).cpu() - volume).abs().max() / volume.abs().max()),
        "forward_ms": latency(lambda: A(x), device),
        "adjoint_ms": latency(lambda: A.T(y), device),
    }


def steps(
    settings: TrainSettings, batch: dict[str, Any], data_range: float, count: int, device: str
) -> dict[str, Any]:
    """The slowest kernels of a training step, and its time."""
    torch.manual_seed(0)
    module = build_module(settings, settings.method, data_range).to(device)
    optimizer = torch.optim.AdamW([p for p in module.parameters() if p.requires_grad], 1e-3)
    batch = move_data_to_device(batch, device)

    def step(number: int) -> None:
        optimizer.zero_grad()
        module.terms(batch)["total"].backward()
        optimizer.step()

    return profiled(step, count, device)


def main() -> None:
    """Entry point."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--device", default="cuda")
    parser.add_argument("--profile", type=int, default=3, help="steps to time and to profile")
    parser.add_argument("settings", nargs="*", help=f"of the experiment {EXPERIMENT}")
    options = parser.parse_args()
    device = on_device(options.device)
    results = Results(options.out, "pinholes")
    few = "data.sizes={train: 2, val: 1, test: 1}"
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
        results.attempt(name, lambda n=name: measure(n))
    for method, of in settings.items():
        given = batch, data.data_range, options.profile, device
        results.attempt(method, lambda s=of, given=given: steps(s, *given))


if __name__ == "__main__":
    main()
