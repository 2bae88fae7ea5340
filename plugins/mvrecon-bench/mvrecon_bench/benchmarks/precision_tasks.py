"""Tasks of `bench=precision`: operators, a U-Net and the cross-view model, in each precision."""

from collections.abc import Callable, Mapping
from copy import deepcopy
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from mvrecon.core.parts import PROJECTORS, SCENES
from mvrecon.data.scenes.solids import voxelise
from mvrecon.methods.learned.unet import PlainUNet
from mvrecon.methods.method import build_method
from mvrecon.operators.ray_transform import RAY_METHODS
from mvrecon.report.metrics import volume_metrics
from mvrecon.training.trained import load
from mvrecon_bench.benchmarks.cases import Workload
from mvrecon_bench.benchmarks.skip_scenes import cube, edge, rig

#: Name -> dtype of volumes and views, and autocast dtype of networks (None: the stored dtype, at
#: least float32).
PRECISIONS: dict[str, tuple[torch.dtype, torch.dtype | None]] = {
    "float64": (torch.float64, None),
    "float32": (torch.float32, None),
    "bfloat16 stored": (torch.bfloat16, None),
    "float16 stored": (torch.float16, None),
    "bfloat16 autocast": (torch.float32, torch.bfloat16),
    "float16 autocast": (torch.float32, torch.float16),
}


@dataclass(frozen=True)
class Task:
    """A task to compute.

    Args:
        call: precision -> a call that computes the task.
        score: PSNR in dB of a call's result, for a trained model.
    """

    call: Callable[[str], Callable[[], Tensor]]
    score: Callable[[Tensor], float] | None = None


def operator_tasks(case: Workload) -> dict[str, Callable[[], Task]]:
    """Forward and adjoint of each method on a case; the adjoint is applied to the forward's
    views.
    """
    return {
        f"{method} {direction}": partial(_operator, case, method, direction)
        for method in RAY_METHODS
        for direction in ("forward", "adjoint")
    }


def _operator(case: Workload, method: str, direction: str) -> Task:
    x = voxelise(case.phantom(), case.grid()).double()[None, None].to(case.device)
    A = PROJECTORS.build("drr", grid=case.grid(), cameras=case.cameras(), method=method).to(
        case.device
    )
    argument = x if direction == "forward" else A(x)

    def call(precision: str) -> Callable[[], Tensor]:
        operand = argument.to(PRECISIONS[precision][0])
        return (lambda: A(operand)) if direction == "forward" else (lambda: A.T(operand))

    return Task(call)


def net_task(options: Mapping[str, Any], device: str) -> Task:
    """A U-Net with random weights on noise."""
    torch.manual_seed(0)
    n, inputs = options["n"], options["inputs"]
    net = PlainUNet(3, inputs, 1, options["widths"]).to(device).eval()
    x = torch.rand(1, inputs, n, n, n, dtype=torch.float64, device=device)
    return Task(lambda precision: _run(net, x, precision))


def method_task(settings: Mapping[str, Any], device: str) -> Task:
    """The cross-view model on one scene: trained, or with random weights in all layers."""
    if trained := settings.get("checkpoint") is not None:
        module = load(Path(settings["checkpoint"])).module
        A, net, scale = module.projector, module.method, module.hparams["data_range"]
    else:
        grid = cube({}, settings["n"])
        A = PROJECTORS.build(
            "drr", grid=grid, cameras=rig(settings["rig"], edge(grid), settings["n"])
        )
        torch.manual_seed(0)
        net, scale = build_method(settings["method"]), 1.0
        for parameter in (
            net.parameters()
        ):  # the last layers are initialised with zeros and would hide the others
            nn.init.normal_(parameter, std=0.1)
    sample = SCENES.build("ellipsoids").sample(0, 1, A.grid, A.cameras)
    views = sample.views[None].double().to(device)

    def score(volume: Tensor) -> float:
        return volume_metrics(volume[0].float().cpu(), sample.volume, sample.inside, scale)["psnr"]

    net, A = net.to(device).eval(), A.to(device)
    return Task(lambda precision: _run(net, views, precision, A), score if trained else None)


def _run(net: nn.Module, x: Tensor, precision: str, *others: Any) -> Callable[[], Tensor]:
    """A network in a precision; half precision is storage only, computed in float32 except under
    autocast.
    """
    stored, auto = PRECISIONS[precision]
    kept = stored if stored == torch.float64 else torch.float32
    own, operand = deepcopy(net).to(kept), x.to(stored).to(kept)
    device = x.device.type

    def call() -> Tensor:
        with torch.autocast(device, dtype=auto, enabled=auto is not None):
            answer = own(operand, *others)
        return getattr(answer, "volume", answer)

    return call
