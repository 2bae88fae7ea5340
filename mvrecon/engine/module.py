"""One model in training, as a LightningModule: its loss, figures of merit and optimiser."""

import math
from collections.abc import Mapping
from typing import Any

import lightning.pytorch as L
from torch import Tensor

from mvrecon.data.rigs import camera_of
from mvrecon.engine.finite import FiniteLoss
from mvrecon.engine.graph import GraphedLoss
from mvrecon.engine.means import Means
from mvrecon.engine.on_case import CaseAttenuation, OnCases, OwnAttenuation, on_cases, plain, singly
from mvrecon.engine.on_rig import OnRig, with_weights_of
from mvrecon.engine.quality import quality_of
from mvrecon.engine.schedule import build_optimizer, build_schedule
from mvrecon.engine.wrong_cameras import TRUTH
from mvrecon.geometry.grid import Grid
from mvrecon.losses import ReconstructionLoss
from mvrecon.metrics import camera_metrics, case_metrics
from mvrecon.models.output import Reconstruction
from mvrecon.parts import CAMERAS, MODELS, PROJECTORS
from mvrecon.projectors.operator import Projector

Settings = dict[str, Any]


def build_projector(
    grid: Mapping[str, Any], camera: Mapping[str, Any], projector: Mapping[str, Any]
) -> Projector:
    """The projector of a grid (options of `Grid.centred`) and a rig (name and options); where its
    mu is that of each case, `OwnAttenuation`.
    """
    rig, attenuation = CAMERAS.from_config(camera), CaseAttenuation.of(projector)
    settings = dict(projector) if attenuation is None else {**projector, "mu": None}
    A = PROJECTORS.from_config(settings, grid=Grid.centred(**grid), cameras=rig)
    return A if attenuation is None else OwnAttenuation(A, projector, attenuation)


class ReconstructionModule(L.LightningModule):
    """A model, its loss and its optimiser, all from plain dicts of names and numbers.

    So a checkpoint loads with torch's defaults. `mvrecon.load(path)` looks through it first;
    Lightning's own way of loading does not (SECURITY.md).

    Args:
        geometry: `grid`, `camera` and `projector`; where the training cases are of many rigs, their
            number as `rigs`.
        model: name and options of the model.
        loss: weights of `ReconstructionLoss`.
        optimizer: name and options, and `schedule` with its `warmup`.
        data_range: value range of the volumes, in their unit.
    """

    def __init__(
        self,
        geometry: Settings,
        model: Settings,
        loss: Settings,
        optimizer: Settings,
        data_range: float,
    ):
        super().__init__()
        self.save_hyperparameters(logger=False)
        self.projector = self._projector(0)
        self.model = MODELS.from_config(model, projector=plain(self.projector))
        rig = OnRig(self.projector, self.model, geometry["projector"], model)
        self._rigs = {0: rig}  # no module: a checkpoint has the weights once
        self.loss = ReconstructionLoss(data_range, **loss)
        self._finite = FiniteLoss(model["name"])
        #: What computes the loss and its gradients in training instead of `terms`; none for those.
        self.graph: GraphedLoss | None = None
        self._means = Means()

    def forward(self, views: Tensor, **case: Tensor) -> Reconstruction:
        """Reconstruct; see the model.

        Args:
            views: as the model takes them.
            case: where the projector's mu is that of each case, "mu" or "mu_measured" [b 1 d h w]
                in 1/mm.
        """
        if not isinstance(self.projector, OwnAttenuation):
            return self.model(views)
        return self.on({"views": views, **case}).model(views)

    @property
    def own(self) -> OnRig:
        """The model on its own rig."""
        return self._rigs[0]

    def _projector(self, rig: int) -> Projector:
        geometry = self.hparams["geometry"]
        camera = camera_of(geometry["camera"], rig)
        return build_projector(geometry["grid"], camera, geometry["projector"])

    def _on_rig(self, batch: dict[str, Any]) -> OnRig:
        """The model on the rig of a batch: its own, or a training rig by its number."""
        rig = int(batch["rig"][0]) if "rig" in batch else 0
        if rig not in self._rigs:
            A, options = self._projector(rig), self.hparams["model"]
            model = with_weights_of(self.model, options, plain(A))
            self._rigs[rig] = OnRig(A, model, self.hparams["geometry"]["projector"], options)
        # its own moves with the module
        return self._rigs[rig].ready(self.device, self.training) if rig else self._rigs[rig]

    def on(self, batch: dict[str, Any]) -> OnRig | OnCases:
        """The model on the rig of a batch, by the operators of its cases where these differ."""
        return on_cases(self._on_rig(batch), batch)

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
        rig = self.on(batch)
        return self._terms(rig, rig.model(batch["views"]), batch)

    def _terms(
        self, rig: OnRig | OnCases, out: Reconstruction, batch: dict[str, Any]
    ) -> dict[str, Tensor]:
        """The loss, with the truth's own views where views are corrected towards them, and the
        cameras' common field where it counts.
        """
        if self.loss.compares_views(out):
            batch = {**batch, "true_views": rig.corrected(batch["volume"])}
        if self.loss.weights["common_field"]:
            batch = {**batch, "common_field": self._on_rig(batch).common_field}
        return self.loss(out, batch)

    def validation_step(self, batch: dict[str, Any], batch_idx: int) -> dict[str, Reconstruction]:
        """Judge a batch by the loss and each of its cases by the figures of merit; hand the
        reconstruction on to the board.
        """
        rig = self.on(batch)
        out = rig.model(batch["views"])
        terms = {f"loss_{name}": value for name, value in self._terms(rig, out, batch).items()}
        predicted = rig.A(out.volume)
        self._means.update({name: value.expand(len(predicted)) for name, value in terms.items()})
        for one, view, case in zip(out.split(), predicted, singly(batch), strict=True):
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
