"""Training steps of a method: time, the slowest kernels, idle time of the device.

    python -m mvrecon_bench.gpu.learn --train openkbp_train.h5 --test openkbp_val.h5 --out FOLDER

Volumes and views are those of the experiment `open_kbp` with a finer grid; all cases are on the
device, without a data loader. Without files the patients are random ellipsoids. `mvrecon-train`
trains and evaluates.
"""

from argparse import Namespace
from collections import defaultdict
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from mvrecon.apps.config import compose
from mvrecon.core.parts import OPTIMIZERS
from mvrecon.data.dataset import Batch
from mvrecon.training.fit import build_data, build_module
from mvrecon.training.module import ReconstructionModule
from mvrecon.training.settings import TrainSettings
from mvrecon_bench.gpu.measuring import Results, on_device, options_of
from mvrecon_bench.measure import once

#: Size in mm of the volume along (x, y, z) and of the detector along (v, u).
FIELD, DETECTOR = (512, 320, 384), (864, 960)
#: `train` and `test` are files of scripts/data/prepare_openkbp.py; `profile` steps run under the
#: profiler.
OPTIONS: dict[str, Any] = {
    **{"train": "", "test": "", "method": "cross_view", "n": 64, "steps": 20, "profile": 8},
    **{"cases": 96, "val": 4, "tests": 33, "batch": 2, "views": 8},
}


def settings_of(options: Namespace, name: str) -> TrainSettings:
    """Settings of the experiment, with a finer grid and detector; patients from two files, or
    random ellipsoids without files.
    """
    n, pixels = options.n, 3 * options.n // 2
    steps, pitch = [mm / n for mm in FIELD], [mm / pixels for mm in DETECTOR]
    sizes = f"{{train: {options.cases}, val: {options.val}, test: {options.tests}}}"
    files = [f"scene.path={options.train}", f"test_scene.path={options.test}"]
    rays = ["scene.vary=false", "scene.rays=1", "test_scene.rays=1"]
    none = ["~scene.path", "~scene.vary", "~test_scene.path"]
    random = ["scene=ellipsoids", "scene@test_scene=ellipsoids", *none]
    settings = compose(
        "experiment=open_kbp",
        f"method={options.method}",
        f"name={name}",
        *([*files, *rays] if options.train and options.test else random),
        f"grid.size=[{n},{n},{n}]",
        f"grid.spacing={steps}",
        f"camera.n_views={options.views}",
        f"camera.detector.pixels=[{pixels},{pixels}]",
        f"camera.detector.pixel_mm={pitch}",
        f"data.batch_size={options.batch}",
        f"data.sizes={sizes}",
        *options.settings,
    )
    return TrainSettings(**settings)


def training_step(
    module: ReconstructionModule, batch_of: Callable[[int], Batch], half: bool = True
) -> Callable[[int], Tensor]:
    """A step of AdamW on the batch of a number, in bfloat16 if `half`: the loss."""
    weights = [p for p in module.parameters() if p.requires_grad and p.numel()]
    optimizer, device = OPTIMIZERS.build("adamw", weights, lr=1e-3), weights[0].device.type

    def step(number: int) -> Tensor:
        with torch.autocast(device, torch.bfloat16, enabled=half):
            loss = module.terms(batch_of(number))["total"]
        optimizer.zero_grad(set_to_none=True)
        loss.backward()
        torch.nn.utils.clip_grad_norm_(weights, 1.0)
        optimizer.step()
        return loss.detach()

    return step


def seconds(step: Callable[[int], Any], numbers: range, device: str) -> float:
    """Duration of some steps."""
    return once(lambda: [step(number) for number in numbers], device)[1]


def profiled(step: Callable[[int], Any], count: int, device: str) -> dict[str, Any]:
    """The slowest kernels of some steps, and the fraction of time in which the device is idle."""
    from torch.profiler import profile

    step(0)
    plain = seconds(step, range(count), device)
    with profile() as recorded:  # all activities supported by this build of torch
        slowed = seconds(step, range(count), device)
    events = [e for e in recorded.events() or [] if is_work(e, device == "cuda")]
    spans = sorted((e.time_range.start, e.time_range.end) for e in events)
    busy, last = 0.0, float("-inf")
    for start, end in spans:  # overlapping intervals count once
        busy += max(0.0, end - max(start, last))
        last = max(last, end)
    by_name: dict[str, list[float]] = defaultdict(list)
    for event in events:
        by_name[event.name[:90]].append(event.time_range.end - event.time_range.start)
    top = sorted(by_name.items(), key=lambda item: -sum(item[1]))[:20]
    return {
        "ms_per_step": 1e3 * plain / count,
        "ms_per_step_profiled": 1e3 * slowed / count,
        "busy_ms_per_step": busy / 1e3 / count,
        "idle_share": max(0.0, 1 - busy / 1e6 / plain),
        "kernels_per_step": len(spans) / count,
        "top": [
            {"kernel": name, "calls": len(us) / count, "ms": sum(us) / 1e3 / count}
            for name, us in top
        ],
    }


def is_work(event: Any, on_gpu: bool) -> bool:
    """Whether a profiler event is a kernel, or an operator on a CPU."""
    if on_gpu:
        return str(getattr(event, "device_type", None)).endswith("CUDA")
    return event.name.startswith(("aten::", "mvrecon::"))


def timed(step: Callable[[int], Tensor], count: int, device: str, results: Results) -> None:
    """Time and loss of some steps."""
    results.add("seconds of the first three steps", seconds(step, range(3), device))
    losses: list[Tensor] = []
    taken = seconds(lambda number: losses.append(step(number)), range(3, 3 + count), device)
    results.add("ms per step", 1e3 * taken / count)
    results.add("loss", [float(losses[0]), float(losses[-1])])
    if device == "cuda":
        results.add("peak MB of a step", torch.cuda.max_memory_allocated() / 2**20)


def main() -> None:
    """Entry point."""
    options = options_of(__doc__, settings=True, **OPTIONS)
    device = on_device(options.device)
    name = f"{options.method}_{options.n}_bf16"
    results = Results(options.out, f"learn_{name}")
    torch.backends.cuda.matmul.allow_tf32 = torch.backends.cudnn.allow_tf32 = True
    torch.backends.cudnn.benchmark = True
    settings = settings_of(options, name)
    data = build_data(settings)
    data.setup("fit")
    torch.manual_seed(0)
    module = build_module(settings, settings.method, data.data_range).to(device)
    results.add("parameters", sum(p.numel() for p in module.parameters()))
    prepared = data.sets["train"].prepare()
    cases = [prepared[key].to(device) for key in ("views", "volume", "inside")]

    def batch_of(number: int) -> Batch:
        rng = torch.Generator().manual_seed(number)
        chosen = torch.randperm(len(cases[0]), generator=rng)[: options.batch].to(device)
        views, volume, inside = (values[chosen] for values in cases)
        return {"views": views, "volume": volume, "inside": inside}

    step = training_step(module, batch_of)
    if options.profile:
        results.attempt("profile", profiled, step, options.profile, device)
    results.attempt("training", timed, step, options.steps, device, results)
    profile = results.facts.get("profile")
    facts = results.facts | (profile if isinstance(profile, dict) else {})
    results.row(run=name, **{k: v for k, v in facts.items() if isinstance(v, int | float)})


if __name__ == "__main__":
    main()
