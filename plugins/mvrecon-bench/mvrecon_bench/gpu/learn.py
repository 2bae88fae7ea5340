"""Profile a method, train it for a given time and evaluate it; results are written at once.

    python -m mvrecon_bench.gpu.learn --train openkbp_train.h5 --test openkbp_val.h5 --out FOLDER

Volumes and views are those of the experiment `open_kbp` with a finer grid; the test patients are
from the second file, which is not used in training. Without files the patients are random
ellipsoids. The number of steps of the cosine schedule is computed from the duration of the first
steps.
"""

import argparse
import math
import time
from collections import defaultdict
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch

from mvrecon.apps.config import compose
from mvrecon.core.parts import OPTIMIZERS
from mvrecon.data.module import SceneData
from mvrecon.report.metrics import mean_and_spread
from mvrecon.training.evaluation import evaluate
from mvrecon.training.fit import build_data, build_module
from mvrecon.training.module import ReconstructionModule, build_schedule
from mvrecon.training.settings import TrainSettings
from mvrecon_bench.gpu.measuring import Results, on_device, wait

#: Size in mm of the volume along (x, y, z) and of the detector along (v, u).
FIELD, DETECTOR = (512, 320, 384), (864, 960)
#: Seconds reserved for the evaluation.
JUDGED = 60.0


def arguments() -> argparse.Namespace:
    """The options of the command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--train", default="", help="of scripts/data/prepare_openkbp.py")
    parser.add_argument("--test", default="")
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--method", default="cross_view")
    parser.add_argument("--n", type=int, default=64)
    parser.add_argument("--seconds", type=float, default=420.0, help="of training alone")
    parser.add_argument("--steps", type=int, default=0, help="instead of seconds")
    parser.add_argument("--profile", type=int, default=8, help="steps under the profiler")
    for name, default in (("cases", 96), ("val", 4), ("tests", 33), ("batch", 2), ("views", 8)):
        parser.add_argument(f"--{name}", type=int, default=default)
    parser.add_argument("--lr", type=float, default=3e-3)
    parser.add_argument("--precision", default="bf16", choices=["bf16", "fp32"])
    parser.add_argument("--compile", action="store_true")
    parser.add_argument("--device", default="cuda")
    parser.add_argument("options", nargs="*", help="more settings, as method.support=hull")
    return parser.parse_args()


def settings_of(options: argparse.Namespace, name: str) -> TrainSettings:
    """Settings of the experiment, with a finer grid and detector."""
    n, pixels = options.n, 3 * options.n // 2
    steps, pitch = [mm / n for mm in FIELD], [mm / pixels for mm in DETECTOR]
    sizes = f"{{train: {options.cases}, val: {options.val}, test: {options.tests}}}"
    settings = compose(
        "experiment=open_kbp",
        f"method={options.method}",
        f"name={name}",
        *scenes_of(options.train, options.test),
        f"grid.size=[{n},{n},{n}]",
        f"grid.spacing={steps}",
        f"camera.n_views={options.views}",
        f"camera.detector.pixels=[{pixels},{pixels}]",
        f"camera.detector.pixel_mm={pitch}",
        f"data.batch_size={options.batch}",
        f"data.sizes={sizes}",
        *options.options,
    )
    return TrainSettings(**settings)


def scenes_of(train: str, test: str) -> list[str]:
    """Settings of the patients: from two files, or random ellipsoids without files."""
    if train and test:
        rays = ["scene.rays=1", "test_scene.rays=1"]
        return [f"scene.path={train}", f"test_scene.path={test}", "scene.vary=false", *rays]
    files = ["~scene.path", "~scene.vary", "~test_scene.path"]
    return ["scene=ellipsoids", "scene@test_scene=ellipsoids", *files]


class Trainer:
    """Training steps with all cases on the device, without a data loader."""

    def __init__(self, module: ReconstructionModule, data: SceneData, options: argparse.Namespace):
        self.module, self.options, self.device = module, options, options.device
        cases = data.sets["train"].prepare()
        self.cases = {key: cases[key].to(self.device) for key in ("views", "volume", "inside")}
        self.weights = [p for p in module.parameters() if p.requires_grad and p.numel()]
        self.optimizer = None
        if self.weights:
            self.optimizer = OPTIMIZERS.build("adamw", self.weights, lr=options.lr)

    def step(self, number: int) -> torch.Tensor:
        """Loss of the batch with a given number, and an optimiser step."""
        assert self.optimizer is not None
        rng = torch.Generator().manual_seed(number)
        count = len(self.cases["views"])
        chosen = torch.randperm(count, generator=rng)[: self.options.batch].to(self.device)
        batch = {key: values[chosen] for key, values in self.cases.items()}
        half = self.options.precision == "bf16"
        with torch.autocast(self.device, torch.bfloat16, enabled=half):
            loss = self.module.terms(batch)["total"]
        self.optimizer.zero_grad(set_to_none=True)
        loss.backward()
        torch.nn.utils.clip_grad_norm_(self.weights, 1.0)
        self.optimizer.step()
        return loss.detach()


def seconds(step: Callable[[int], Any], numbers: range, device: str) -> float:
    """Duration of some steps."""
    wait(device)
    start = time.perf_counter()
    for number in numbers:
        step(number)
    wait(device)
    return time.perf_counter() - start


def train(trainer: Trainer, results: Results) -> None:
    """Train for the requested time or number of steps."""
    options = trainer.options
    results.add("seconds of the first three steps", seconds(trainer.step, range(3), trainer.device))
    some = range(3, 13 if options.device == "cuda" else 5)
    one = seconds(trainer.step, some, trainer.device) / len(some)
    results.add("ms per step", 1e3 * one)
    if options.device == "cuda":
        results.add("peak MB of a step", torch.cuda.max_memory_allocated() / 2**20)
    most = min(options.seconds, results.left() - JUDGED)
    steps = options.steps or max(5, int(most / one))
    results.add("steps", steps)
    assert trainer.optimizer is not None
    schedule = build_schedule(trainer.optimizer, "cosine", steps, 0.05)
    losses, start = [], time.perf_counter()
    for step in range(1, steps + 1):
        losses.append(trainer.step(100 + step))
        schedule.step()
        if step % max(1, steps // 20) == 0:
            mean, took = float(torch.stack(losses).mean()), time.perf_counter() - start
            losses.clear()
            results.row(step=step, seconds=took, loss=mean, ms_per_step=1e3 * took / step)
            late = took > most * 1.15
            if mean != mean or late:
                results.add("stopped", f"after {step} steps, loss {mean}")
                break
    results.add("seconds of training", time.perf_counter() - start)


def profiled(step: Callable[[int], Any], count: int, device: str) -> dict[str, Any]:
    """The slowest kernels of some steps, and the fraction of time in which the device is idle."""
    from torch.profiler import profile

    on_gpu = device == "cuda"
    step(0)
    plain = seconds(step, range(count), device)
    with profile() as recorded:  # all activities supported by this build of torch
        slowed = seconds(step, range(count), device)
    events = [e for e in recorded.events() or [] if is_work(e, on_gpu)]
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


def judged(
    module: ReconstructionModule, data: SceneData, options: argparse.Namespace
) -> dict[str, Any]:
    """Figures of merit on the test patients, in the precision of the training."""
    data.setup("test")
    method, half = module.method, options.precision == "bf16"
    method.forward = torch.autocast(options.device, torch.bfloat16, enabled=half)(method.forward)
    judge = module.projector, data.data_range, options.device
    scores = evaluate({"one": method}, data.test_dataloader(), *judge)["one"]
    numbers = [key for key, value in scores[0].items() if isinstance(value, int | float)]
    failed = any(math.isnan(score["nrmse"]) for score in scores)
    figures = {key: mean_and_spread([score[key] for score in scores], failed) for key in numbers}
    return {"scenes": len(scores)} | {
        key: {k: figure[k] for k in ("mean", "std")} for key, figure in figures.items()
    }


def main() -> None:
    """Entry point."""
    options = arguments()
    options.device = on_device(options.device)
    name = f"{options.method}_{options.n}_{options.precision}" + "_compiled" * options.compile
    results = Results(options.out, f"learn_{name}")
    torch.backends.cuda.matmul.allow_tf32 = torch.backends.cudnn.allow_tf32 = True
    torch.backends.cudnn.benchmark = True
    settings = settings_of(options, name)
    data = build_data(settings)
    data.setup("fit")
    torch.manual_seed(0)
    module = build_module(settings, settings.method, data.data_range).to(options.device)
    results.add("parameters", sum(p.numel() for p in module.parameters()))
    if options.compile:
        module.method.compile()
    trainer = Trainer(module, data, options)
    if trainer.weights:
        if options.profile:
            results.attempt(
                "profile", lambda: profiled(trainer.step, options.profile, trainer.device)
            )
        results.attempt("training", lambda: train(trainer, results))
    results.attempt("figures", lambda: judged(module.eval(), data, options))


if __name__ == "__main__":
    main()
