"""Training of one method as a LightningModule: loss, figures of merit and optimiser."""

import math
from collections.abc import Mapping
from typing import Any, Literal, TypedDict

import lightning.pytorch as L
import torch
from jaxtyping import Float
from torch import Tensor, distributed
from torch.optim.lr_scheduler import LambdaLR
from torchmetrics import MeanMetric

from mvrecon.core.parts import CAMERAS, OPTIMIZERS, PROJECTORS, CameraPart, Options, ProjectorPart
from mvrecon.core.quantities import NonNegativeFloat, PositiveFloat
from mvrecon.core.registry import hint
from mvrecon.data.dataset import Batch, camera_of, single_cases
from mvrecon.geometry.cameras.field import common_field
from mvrecon.geometry.grid import Grid
from mvrecon.methods.method import Reconstruction, build_method
from mvrecon.operators.memo import kept
from mvrecon.operators.operator import Projector
from mvrecon.report.cameras import TRUE_KEYS, camera_metrics
from mvrecon.report.metrics import case_metrics
from mvrecon.report.quality import quality_of
from mvrecon.training.checkpoints import TrainingState
from mvrecon.training.loop import optimizer_steps
from mvrecon.training.losses import ReconstructionLoss

SCHEDULES = ("cosine", "one_cycle", "constant")


class Schedule(TypedDict, total=False):
    """Settings of an optimiser beside its own options.

    Args:
        lr: greatest learning rate of the schedule.
        schedule: course of the learning rate over the steps: cosine, one_cycle or constant.
        warmup: share of the steps with a rising rate.
    """

    lr: PositiveFloat
    weight_decay: NonNegativeFloat
    momentum: NonNegativeFloat
    schedule: Literal["cosine", "one_cycle", "constant"]
    warmup: NonNegativeFloat


def lr_factor(name: str, step: int, steps: int, warmup: float) -> float:
    """Return the learning rate at a step relative to the maximum.

    All rise first, "cosine" and "constant" linearly over the first `warmup` of the steps,
    "one_cycle" along half a cosine from 1/25; "cosine" and "one_cycle" then fall to zero along half
    a cosine (Loshchilov & Hutter 2017; Smith & Topin 2019).
    """
    rise = warmup * steps
    if step < rise and name == "one_cycle":
        return 1 - (1 - 1 / 25) * 0.5 * (1 + math.cos(math.pi * step / rise))
    if step < rise:
        return (step + 1) / (rise + 1)
    if name == "constant":
        return 1.0
    return 0.5 * (1 + math.cos(math.pi * min(1.0, (step - rise) / max(1.0, steps - rise))))


def build_schedule(
    optimizer: torch.optim.Optimizer, name: str, steps: float, warmup: float = 0.0
) -> LambdaLR:
    """Build a learning-rate schedule over a known number of optimiser steps; see `lr_factor`.

    Raises:
        LookupError: an unknown name.
        ValueError: an unlimited number of steps, or a warm-up outside [0, 1).
    """
    if name not in SCHEDULES:
        raise LookupError(f"No schedule is named {name!r}{hint(name, SCHEDULES)}")
    if not 0 <= warmup < 1:
        raise ValueError(f"warmup must be a share of the steps in [0, 1), got {warmup}")
    if not 0 < steps < math.inf:
        raise ValueError(
            f"A schedule needs a known number of steps, got {steps}; set trainer.max_steps"
        )
    return LambdaLR(optimizer, lambda step: lr_factor(name, step, int(steps), warmup))


class DistributedMeans:
    """Means by name over all cases and processes of a run (torchmetrics' MeanMetric); nan if any
    value is.
    """

    def __init__(self) -> None:
        self._means: dict[str, MeanMetric] = {}

    def update(self, values: Mapping[str, Float[Tensor, " n"]]) -> None:
        """Add the figures of n >= 0 cases one by one: torchmetrics 1.9 ignores weights of nan."""
        for name, value in values.items():
            if name not in self._means:
                self._means[name] = MeanMetric(nan_strategy="disable").to(value.device)
            self._means[name].update(value.detach())

    def compute(self) -> dict[str, Tensor]:
        """Return the means by name and reset; all processes must call this together."""
        means = {name: self._means[name].compute() for name in sorted(self._means)}
        self._means.clear()
        return means


class NanGuard:
    """Check that the terms of every loss are finite: immediately on a CPU, every few steps on a
    GPU, where a check synchronises.

    Args:
        method: name of the method, for the error.
    """

    def __init__(self, method: str):
        self.method = method
        self._pending: list[tuple[int, list[str], Float[Tensor, " k"]]] = []

    def add(self, step: int, terms: Mapping[str, Float[Tensor, ""]], together: int) -> None:
        """Check the terms of a step, once `together` steps have been collected.

        Raises:
            FloatingPointError: a total that is not finite, with the first such step's terms.
        """
        values = torch.stack([value.detach() for value in terms.values()])
        self._pending.append((step, list(terms), values))
        if values.is_cpu or len(self._pending) >= together:
            self.check()

    def check(self) -> None:
        """Check all collected steps.

        Raises:
            FloatingPointError: as `add`.
        """
        pending, self._pending = self._pending, []
        if not pending:
            return
        steps, names, terms = zip(*pending, strict=True)
        for step, values in zip(steps, torch.stack(terms).tolist(), strict=True):
            shown = dict(zip(names[0], values, strict=True))
            if not math.isfinite(shown["total"]):
                text = ", ".join(f"{name} {value:.4g}" for name, value in shown.items())
                raise FloatingPointError(
                    f"The loss of {self.method} is not finite at step {step}: {text}. Lower "
                    f"optimizer.lr, set trainer.gradient_clip_val, or look for bad values in the "
                    f"data"
                )


def build_projector(grid: Options, camera: CameraPart, projector: ProjectorPart) -> Projector:
    """The projector of a grid (options of `Grid.centred`) and a rig (name and options)."""
    cameras = CAMERAS.from_config(camera)
    return PROJECTORS.from_config(projector, grid=Grid.centred(**grid), cameras=cameras)


class ReconstructionModule(L.LightningModule):
    """A method, its loss and its optimiser, all from plain dicts of names and numbers.

    Hence a checkpoint loads with torch's defaults. `mvrecon.load(path)` validates it first;
    Lightning's own loading does not (SECURITY.md).

    Args:
        geometry: `grid`, `camera` and `projector`; with `rigs`, the number of rigs of the training
            cases.
        method: name and options of the method.
        loss: weights of `ReconstructionLoss`.
        optimizer: name and options, and `schedule` with its `warmup`.
        data_range: value range of the volumes, in their unit.
    """

    def __init__(
        self,
        geometry: Options,
        method: Options,
        loss: Mapping[str, float],
        optimizer: Options,
        data_range: float,
    ):
        super().__init__()
        self.save_hyperparameters(logger=False)
        self.projector = self._projector(0)
        self.method = build_method(method)
        self._operators: dict[int, Projector] = {}  # of training rigs; not submodules
        self.loss = ReconstructionLoss(data_range, **loss)
        self._guard = NanGuard(method["name"])
        self._means = DistributedMeans()
        self._gradients: dict[str, Float[Tensor, "world ..."]] = {}  # of a resumed accumulation

    def forward(self, views: Tensor, A: Projector | None = None) -> Reconstruction:
        """Reconstruct views [b 1 m v u] by the method.

        Args:
            views: the views, in the operator's unit.
            A: the operator of the views; None: that of the run.
        """
        return self.method(views, self.projector if A is None else A)

    def _projector(self, rig: int) -> Projector:
        geometry = self.hparams["geometry"]
        camera = camera_of(geometry["camera"], rig)
        return build_projector(geometry["grid"], camera, geometry["projector"])

    def _rig(self, batch: Batch) -> Projector:
        """The operator of a batch's rig: the run's own, or a training rig's by its number."""
        rig = int(batch["rig"][0]) if "rig" in batch else 0
        if not rig:
            return self.projector
        if rig not in self._operators:
            self._operators[rig] = self._projector(rig)
        return self._operators[rig].to(self.device)

    def operator(self, batch: Batch) -> Projector:
        """The operator of a batch's views."""
        return self._rig(batch).for_case(batch)

    def on_train_start(self) -> None:
        """Set the learning rate by the schedule: that of the new length for an extended training,
        else exactly the checkpoint's; and the gradients of an interrupted accumulation.
        """
        schedule: Any = self.lr_schedulers()
        by_group = schedule.optimizer.param_groups, schedule.base_lrs, schedule.lr_lambdas
        for group, highest, factor in zip(*by_group, strict=True):
            group["lr"] = highest * factor(schedule.last_epoch)
        gradients, self._gradients = self._gradients, {}
        for name, weight in self.named_parameters():
            if name in gradients:
                of_all, world = gradients[name].to(weight), self.trainer.world_size
                same = len(of_all) == world  # a step averages over the processes
                weight.grad = of_all[self.global_rank] if same else of_all.mean(0)

    def optimizer_zero_grad(self, epoch: int, batch_idx: int, optimizer: Any) -> None:
        """Keep the gradients, which Lightning would zero by a count of batches within the epoch."""

    def optimizer_step(
        self, epoch: int, batch_idx: int, optimizer: Any, optimizer_closure: Any = None
    ) -> None:
        """Take a step and zero the gradients, so that whatever gradients there are belong to the
        next one.
        """
        super().optimizer_step(epoch, batch_idx, optimizer, optimizer_closure)
        optimizer.zero_grad()

    def training_step(self, batch: Batch, batch_idx: int) -> Tensor:
        """The loss of one batch.

        Raises:
            FloatingPointError: a loss that is not finite, in this step or on a GPU since the last
                check.
        """
        terms = self.terms(batch)
        together = max(1, self.trainer.log_every_n_steps)  # pyrefly: ignore[missing-attribute]
        self._guard.add(self.global_step, terms, together)
        for name, value in terms.items():
            self.log(
                f"loss/{name}",
                value.detach(),
                prog_bar=name == "total",
                batch_size=len(batch["views"]),
                sync_dist=True,
            )
        return terms["total"]

    def on_save_checkpoint(self, checkpoint: TrainingState) -> None:
        """Check all collected losses, so that no bad weights replace good ones; within an
        accumulation, store every process's gradients.
        """
        self._guard.check()
        gradients = {n: p.grad for n, p in self.named_parameters() if p.grad is not None}
        if gradients:
            checkpoint["gradients"] = {name: _of_all(one) for name, one in gradients.items()}

    def on_load_checkpoint(self, checkpoint: TrainingState) -> None:
        """Keep the gradients of an interrupted accumulation until training starts."""
        self._gradients = checkpoint.get("gradients", {})

    def terms(self, batch: Batch, out: Reconstruction | None = None) -> dict[str, Tensor]:
        """Compute the terms of a batch's loss from its reconstruction, which is computed if not
        given; with the cameras' common field if that is weighted.
        """
        out = self.method(batch["views"], self.operator(batch)) if out is None else out
        if "common_field" in self.loss.terms:
            A = self._rig(batch)
            field = kept(A, "common field", lambda: common_field(A.cameras, A.grid))
            batch = {**batch, "common_field": field}
        return self.loss(out, batch)

    def validation_step(self, batch: Batch, batch_idx: int) -> dict[str, Reconstruction]:
        """Compute the loss of a batch and the figures of merit of its cases; return the
        reconstruction for pictures.
        """
        A = self.operator(batch)
        out = self.method(batch["views"], A)
        terms = {f"loss_{name}": value for name, value in self.terms(batch, out).items()}
        predicted = A(out.volume)
        self._means.update({name: value.expand(len(predicted)) for name, value in terms.items()})
        for one, views, case in zip(out.split(), predicted, single_cases(batch), strict=True):
            figures = case_metrics(one.volume[0], views, case, self.hparams["data_range"])
            figures |= {f"quality_{name}": value for name, value in quality_of(one, case).items()}
            if one.alignment is not None and "gain" in case:
                known = camera_metrics(one.alignment, *(case[key] for key in TRUE_KEYS))
                figures |= {f"cameras_{name}": value for name, value in known.items()}
            if one.support is not None:
                figures["support_fraction"] = one.support.float().mean().item()
            failed = math.isnan(figures["nrmse"])
            # nan means failure for a volume, but not applicable for a scene without an object
            told = {k: [v] if failed or not math.isnan(v) else [] for k, v in figures.items()}
            self._means.update({name: views.new_tensor(value) for name, value in told.items()})
        return {"out": out}

    def on_validation_epoch_end(self) -> None:
        """Log the means over the cases of all processes."""
        for name, value in self._means.compute().items():
            self.log(f"val/{name}", value, prog_bar=name == "psnr", sync_dist=True)  # equal already

    def build_optimizer(self) -> torch.optim.Optimizer:
        """The optimiser of the trainable weights."""
        own = ("name", "schedule", "warmup")
        options = {k: v for k, v in self.hparams["optimizer"].items() if k not in own}
        weights = [p for p in self.parameters() if p.requires_grad]
        return OPTIMIZERS.build(self.hparams["optimizer"]["name"], weights, **options)

    def configure_optimizers(self) -> Any:
        """The optimiser, with its schedule over all steps, updated at every step."""
        options, optimizer = self.hparams["optimizer"], self.build_optimizer()
        schedule, warmup = options.get("schedule", "cosine"), options.get("warmup", 0.0)
        scheduler = build_schedule(optimizer, schedule, optimizer_steps(self.trainer), warmup)
        return {
            "optimizer": optimizer,
            "lr_scheduler": {"scheduler": scheduler, "interval": "step"},
        }


def _of_all(value: Float[Tensor, "..."]) -> Float[Tensor, "world ..."]:
    """A tensor of every process."""
    if not distributed.is_initialized():
        return value[None]
    values = [torch.empty_like(value) for _ in range(distributed.get_world_size())]
    distributed.all_gather(values, value.contiguous())
    return torch.stack(values)
