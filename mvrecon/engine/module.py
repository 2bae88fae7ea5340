"""One method in training, as a LightningModule: its loss, figures of merit and optimiser."""

import math
from collections.abc import Mapping
from typing import Any

import lightning.pytorch as L
from torch import Tensor

from mvrecon.cameras.field import common_field
from mvrecon.data.dataset import single_cases
from mvrecon.data.rigs import camera_of
from mvrecon.engine.finite import FiniteLoss
from mvrecon.engine.graph import GraphedLoss
from mvrecon.engine.means import Means
from mvrecon.engine.quality import quality_of
from mvrecon.engine.schedule import build_optimizer, build_schedule
from mvrecon.engine.wrong_cameras import TRUTH
from mvrecon.geometry.grid import Grid
from mvrecon.losses import ReconstructionLoss
from mvrecon.metrics import camera_metrics, case_metrics
from mvrecon.models.geometry import kept
from mvrecon.models.method import build_method
from mvrecon.models.output import Reconstruction
from mvrecon.parts import CAMERAS, PROJECTORS
from mvrecon.projectors.operator import Projector

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
        self._finite = FiniteLoss(method["name"])
        #: What computes the loss and its gradients in training instead of `terms`; none for those.
        self.graph: GraphedLoss | None = None
        self._means = Means()

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
        """Set the learning rate by the schedule: a training that was lengthened goes on with that
        of its new length, any other with the rate of its checkpoint, to the last bit.
        """
        schedule: Any = self.lr_schedulers()
        for group, highest, share in zip(
            schedule.optimizer.param_groups, schedule.base_lrs, schedule.lr_lambdas, strict=True
        ):
            group["lr"] = highest * share(schedule.last_epoch)

    def training_step(self, batch: dict[str, Any], batch_idx: int) -> Tensor:
        """The loss of one batch.

        Raises:
            FloatingPointError: a loss that is not finite, of this step or on a GPU of one since the
                last that was logged.
        """
        terms = self.terms(batch) if self.graph is None else self.graph(batch)
        together = max(1, self.trainer.log_every_n_steps)  # pyright: ignore[reportAttributeAccessIssue]
        self._finite.add(self.global_step, terms, together)
        for name, value in terms.items():
            self.log(
                f"loss/{name}",
                value.detach(),
                prog_bar=name == "total",
                batch_size=len(batch["views"]),
                sync_dist=True,
            )
        return terms["total"]

    def as_graph(self) -> None:
        """Train with a CUDA graph from now on; see `GraphedLoss`."""
        self.graph = GraphedLoss(self.terms, [p for p in self.parameters() if p.requires_grad])

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Check the losses that have not been checked yet: no bad weights take the place of good
        ones.
        """
        self._finite.look()

    def terms(self, batch: dict[str, Any]) -> dict[str, Tensor]:
        """The terms of the loss of a batch."""
        return self._terms(self.method(batch["views"], self.operator(batch)), batch)

    def _terms(self, out: Reconstruction, batch: dict[str, Any]) -> dict[str, Tensor]:
        """The loss, with the cameras' common field where it has a weight."""
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
        terms = {f"loss_{name}": value for name, value in self._terms(out, batch).items()}
        predicted = A(out.volume)
        self._means.update({name: value.expand(len(predicted)) for name, value in terms.items()})
        for one, view, case in zip(out.split(), predicted, single_cases(batch), strict=True):
            figures = self._figures(one, view, case)
            failed = math.isnan(figures["nrmse"])
            # without an object in the scene, nan is no figure; of a volume that has failed, it is
            told = {k: [v] if failed or not math.isnan(v) else [] for k, v in figures.items()}
            self._means.update({name: view.new_tensor(value) for name, value in told.items()})
        return {"out": out}

    def _figures(
        self, out: Reconstruction, views: Tensor, case: dict[str, Any]
    ) -> dict[str, float]:
        """Everything that judges the reconstruction of one case and its views."""
        figures = case_metrics(out.volume[0], views, case, self.hparams["data_range"])
        figures |= {f"quality_{name}": value for name, value in quality_of(out, case).items()}
        if out.alignment is not None and "gain" in case:
            known = camera_metrics(out.alignment, *(case[key] for key in TRUTH))
            figures |= {f"cameras_{name}": value for name, value in known.items()}
        if out.support is not None:
            figures["support_fraction"] = out.support.float().mean().item()
        return figures

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
        optimizer = build_optimizer((p for p in self.parameters() if p.requires_grad), **options)
        scheduler = build_schedule(
            optimizer, schedule, self.trainer.estimated_stepping_batches, warmup
        )
        return {
            "optimizer": optimizer,
            "lr_scheduler": {"scheduler": scheduler, "interval": "step"},
        }
