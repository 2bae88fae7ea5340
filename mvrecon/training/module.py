"""One method in training, as a LightningModule: its loss, figures of merit and optimiser."""

import math
from collections.abc import Mapping
from typing import Any

import lightning.pytorch as L
import torch
from jaxtyping import Float
from torch import Tensor
from torch.optim.lr_scheduler import LambdaLR
from torchmetrics import MeanMetric

from mvrecon.core.files.checks import plain_name
from mvrecon.core.parts import CAMERAS, OPTIMIZERS, PROJECTORS
from mvrecon.core.registry import hint
from mvrecon.data.dataset import camera_of, single_cases
from mvrecon.geometry.cameras.field import common_field
from mvrecon.geometry.grid import Grid
from mvrecon.methods.learned.geometry import kept
from mvrecon.methods.method import Reconstruction, build_method
from mvrecon.operators.operator import Projector
from mvrecon.report.metrics import TRUTH, camera_metrics, case_metrics, quality_of
from mvrecon.training.losses import ReconstructionLoss

SCHEDULES = ("cosine", "one_cycle", "constant")


def lr_factor(name: str, step: int, steps: int, warmup: float) -> float:
    """The learning rate at a step relative to the highest one.

    "cosine" and "constant" rise linearly over the first `warmup` of the steps, "one_cycle" along
    half a cosine from 1/25; "cosine" and "one_cycle" then fall to zero along half a cosine
    (Loshchilov & Hutter 2017; Smith & Topin 2019).
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
    """A learning-rate schedule over a known number of optimiser steps; see `lr_factor`.

    Raises:
        LookupError: an unknown name.
        ValueError: a number of steps that is not known, or a warm-up that is not in [0, 1).
    """
    if name not in SCHEDULES:
        raise LookupError(f"No schedule is named {name!r}{hint(name, SCHEDULES)}")
    if not 0 <= warmup < 1:
        raise ValueError(f"warmup must be a share of the steps in [0, 1), got {warmup}")
    if not 0 < steps < math.inf:
        raise ValueError(
            f"A schedule needs to know the number of steps, got {steps}; set trainer.max_steps"
        )
    return LambdaLR(optimizer, lambda step: lr_factor(name, step, int(steps), warmup))


class DistributedMeans:
    """Means by name, over all cases and all processes of a run (torchmetrics' MeanMetric, which
    sums over them); a case whose figure is nan makes the mean nan.
    """

    def __init__(self) -> None:
        self._means: dict[str, MeanMetric] = {}

    def update(self, values: Mapping[str, Float[Tensor, " n"]]) -> None:
        """Add the figures of n cases, which may be none, each by itself: torchmetrics 1.9 leaves a
        weight out where nan counts.
        """
        for name, value in values.items():
            if name not in self._means:
                self._means[name] = MeanMetric(nan_strategy="disable").to(value.device)
            self._means[name].update(value.detach())

    def compute(self) -> dict[str, Tensor]:
        """The means by name, and begin anew; all processes call this together."""
        means = {name: self._means[name].compute() for name in sorted(self._means)}
        self._means.clear()
        return means


class NanGuard:
    """Check that the terms of every loss are finite: in main memory at once, on a GPU some steps at
    a time, since each check synchronises.

    Args:
        method: its name, for the error.
    """

    def __init__(self, method: str):
        self.method = method
        self._pending: list[tuple[int, list[str], Float[Tensor, " k"]]] = []

    def add(self, step: int, terms: Mapping[str, Float[Tensor, ""]], together: int) -> None:
        """Check the terms of a step, or those of as many steps as go together.

        Raises:
            FloatingPointError: a total that is not finite, with the first such step's terms.
        """
        values = torch.stack([value.detach() for value in terms.values()])
        self._pending.append((step, list(terms), values))
        if values.is_cpu or len(self._pending) >= together:
            self.check()

    def check(self) -> None:
        """Check all steps that have not been checked yet.

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


Settings = dict[str, Any]


def build_projector(
    grid: Mapping[str, Any], camera: Mapping[str, Any], projector: Mapping[str, Any]
) -> Projector:
    """The projector of a grid (options of `Grid.centred`) and a rig (name and options)."""
    cameras = CAMERAS.from_config(camera)
    return PROJECTORS.from_config(projector, grid=Grid.centred(**grid), cameras=cameras)


class ReconstructionModule(L.LightningModule):
    """A method, its loss and its optimiser, all from plain dicts of names and numbers.

    So a checkpoint loads with torch's defaults. `mvrecon.load(path)` looks through it first;
    Lightning's own way of loading does not (SECURITY.md).

    Args:
        geometry: `grid`, `camera` and `projector`; where the training cases are of many rigs, their
            number as `rigs`.
        method: name and options of the method.
        loss: weights of `ReconstructionLoss`.
        optimizer: name and options, and `schedule` with its `warmup`.
        data_range: value range of the volumes, in their unit.
    """

    def __init__(
        self,
        geometry: Settings,
        method: Settings,
        loss: Settings,
        optimizer: Settings,
        data_range: float,
    ):
        super().__init__()
        self.save_hyperparameters(logger=False)
        self.projector = self._projector(0)
        self.method = build_method(method)
        self._operators: dict[int, Projector] = {}  # of training rigs; no modules of this one
        self.loss = ReconstructionLoss(data_range, **loss)
        self._guard = NanGuard(method["name"])
        self._means = DistributedMeans()

    def forward(self, views: Tensor, A: Projector | None = None) -> Reconstruction:
        """The reconstruction of views [b 1 m v u] by the method; see there.

        Args:
            views: in the operator's unit.
            A: the operator that made them; None: that of the run.
        """
        return self.method(views, self.projector if A is None else A)

    def _projector(self, rig: int) -> Projector:
        geometry = self.hparams["geometry"]
        camera = camera_of(geometry["camera"], rig)
        return build_projector(geometry["grid"], camera, geometry["projector"])

    def _rig(self, batch: dict[str, Any]) -> Projector:
        """The operator of a batch's rig: the run's own, or that of a training rig by its number."""
        rig = int(batch["rig"][0]) if "rig" in batch else 0
        if not rig:
            return self.projector
        if rig not in self._operators:
            self._operators[rig] = self._projector(rig)
        return self._operators[rig].to(self.device)

    def operator(self, batch: dict[str, Any]) -> Projector:
        """The operator that made the views of a batch."""
        return self._rig(batch).for_case(batch)

    def on_train_start(self) -> None:
        """Set the learning rate by the schedule: a training that was extended resumes with that
        of its new length, any other with the rate of its checkpoint, to the last bit.
        """
        schedule: Any = self.lr_schedulers()
        for group, highest, factor in zip(
            schedule.optimizer.param_groups, schedule.base_lrs, schedule.lr_lambdas, strict=True
        ):
            group["lr"] = highest * factor(schedule.last_epoch)

    def training_step(self, batch: dict[str, Any], batch_idx: int) -> Tensor:
        """The loss of one batch.

        Raises:
            FloatingPointError: a loss that is not finite, of this step or on a GPU of one since the
                last that was logged.
        """
        terms = self.terms(batch)
        together = max(1, self.trainer.log_every_n_steps)  # pyright: ignore[reportAttributeAccessIssue]
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

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Check the losses that have not been checked yet: no bad weights take the place of good
        ones.
        """
        self._guard.check()

    def terms(self, batch: dict[str, Any], out: Reconstruction | None = None) -> dict[str, Tensor]:
        """The terms of the loss of a batch and of its reconstruction, which is computed unless it
        is given; with the cameras' common field where that has a weight.
        """
        out = self.method(batch["views"], self.operator(batch)) if out is None else out
        if self.loss.weights["common_field"]:
            A = self._rig(batch)
            field = kept(A, "common field", lambda: common_field(A.cameras, A.grid))
            batch = {**batch, "common_field": field}
        return self.loss(out, batch)

    def validation_step(self, batch: dict[str, Any], batch_idx: int) -> dict[str, Reconstruction]:
        """Judge a batch by the loss and each of its cases by the figures of merit; hand the
        reconstruction on to the board.
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
                known = camera_metrics(one.alignment, *(case[key] for key in TRUTH))
                figures |= {f"cameras_{name}": value for name, value in known.items()}
            if one.support is not None:
                figures["support_fraction"] = one.support.float().mean().item()
            failed = math.isnan(figures["nrmse"])
            # without an object in the scene, nan is no figure; of a volume that has failed, it is
            told = {k: [v] if failed or not math.isnan(v) else [] for k, v in figures.items()}
            self._means.update({name: views.new_tensor(value) for name, value in told.items()})
        return {"out": out}

    def on_validation_epoch_end(self) -> None:
        """Log the means over the cases of all processes."""
        for name, value in self._means.compute().items():
            self.log(f"val/{name}", value, prog_bar=name == "psnr", sync_dist=True)  # equal already

    def configure_optimizers(self) -> Any:
        """The optimiser, and its schedule over the whole number of steps, moved on at every
        step.
        """
        options = dict(self.hparams["optimizer"])
        schedule, warmup = options.pop("schedule", "cosine"), options.pop("warmup", 0.0)
        weights = [p for p in self.parameters() if p.requires_grad]
        optimizer = OPTIMIZERS.build(options.pop("name"), weights, **options)
        scheduler = build_schedule(
            optimizer, schedule, self.trainer.estimated_stepping_batches, warmup
        )
        return {
            "optimizer": optimizer,
            "lr_scheduler": {"scheduler": scheduler, "interval": "step"},
        }


def methods(settings: Settings) -> dict[str, Settings]:
    """The methods of a run's result table by label: the main one first, under `label` or, where the
    settings have none, its class's name; then those of `compare` that are not null.

    Raises:
        ValueError: the main method's label is taken twice, or a label is no plain name: files are
            called by it. "truth" is refused: its file is the truth's own.
    """
    main = settings["method"]
    label = settings.get("label") or main["name"]
    others = {label: model for label, model in settings.get("compare", {}).items() if model}
    if label in others:
        raise ValueError(
            f"compare holds {label!r}, which is the main method's own label; give this one another "
            f"by label=..., or leave the other out by compare.{label}=null"
        )
    labelled = {label: main, **others}
    # whatever the case: some file systems do not tell it
    if taken := [label for label in labelled if str(label).casefold() == "truth"]:
        raise ValueError(
            f"A method labelled {taken[0]!r} would overwrite truth.nii.gz; expected another label"
        )
    return {plain_name(label, "a method"): model for label, model in labelled.items()}
