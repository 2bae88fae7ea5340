"""Callbacks of a training: run time, memory, compilation, and pictures for TensorBoard."""

import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import lightning.pytorch as L
import torch
from jaxtyping import Bool, Float
from lightning.pytorch.loggers import TensorBoardLogger
from torch import Tensor
from torch.nn.functional import max_pool3d, pad

from mvrecon.engine.export import save_png
from mvrecon.engine.run_folder import versions
from mvrecon.files.memory import peak, restarted_peak
from mvrecon.files.places import check_places
from mvrecon.models.output import Reconstruction
from mvrecon.parts import MODELS
from mvrecon.viz import cameras, montage
from mvrecon.viz.planes import Image


def peak_megabytes() -> dict[str, float]:
    """Peak memory so far in units of 2^20 bytes: of the GPU if there is one, else of this process;
    empty if it is not known.
    """
    peak_bytes = torch.cuda.max_memory_allocated() if torch.cuda.is_available() else peak()
    return {} if peak_bytes is None else {"peak_mb": peak_bytes / 2**20}


class Clock(L.Callback):
    """Logs `time/*`: milliseconds per step, volumes per second, seconds of training so far, peak
    memory.

    Validation and pictures do not count. The seconds go into the checkpoint, so a resumed run adds
    to them. Windows does not tell the memory.
    """

    of_every_run = True

    def __init__(self) -> None:
        self.seconds = 0.0
        self._mark = 0.0

    def state_dict(self) -> dict[str, Any]:
        """What a checkpoint keeps."""
        return {"seconds": self.seconds}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Go on from a checkpoint."""
        self.seconds = state_dict["seconds"]

    def on_train_start(self, *_: Any) -> None:
        """Start."""
        restarted_peak()  # one process trains several methods
        if torch.cuda.is_available():
            torch.cuda.reset_peak_memory_stats()
        self._mark = time.perf_counter()

    def on_validation_end(self, *_: Any) -> None:
        """Exclude the time of the validation."""
        self._mark = time.perf_counter()

    def on_train_batch_end(
        self, trainer: Any, pl_module: Any, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        """One step, its data included."""
        now = time.perf_counter()
        step, self._mark = now - self._mark, now
        self.seconds += step
        count = len(batch["views"])
        speed = count * trainer.world_size / step
        figures = {"step_ms": 1e3 * step, "volumes_per_s": speed, "seconds": self.seconds}
        figures |= peak_megabytes()
        # as tensors in main memory: Lightning would copy plain numbers to a GPU, and wait for it
        logged = {f"time/{name}": torch.tensor(value) for name, value in figures.items()}
        pl_module.log_dict(logged, batch_size=count)


class Confined(L.Callback):
    """Refuses a training whose callbacks or loggers would write outside the run folder.

    Their options were looked at when they were built; a checkpoint to go on from may hold other
    places.

    Args:
        folder: the run folder.
    """

    of_every_run = True

    def __init__(self, folder: Path):
        self.folder = folder

    def on_fit_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Check the paths after all states are restored.

        Raises:
            PermissionError: a place outside the folder.
        """
        for thing in (*trainer.callbacks, *trainer.loggers):  # pyright: ignore[reportAttributeAccessIssue]
            check_places(thing, self.folder)


class CompileModel(L.Callback):
    """Compiles the network before training. Never the LightningModule, whose logging must not be
    traced.
    """

    def setup(self, trainer: L.Trainer, pl_module: Any, stage: str) -> None:
        """Compile in place; names of parameters stay."""
        if stage == "fit":
            pl_module.model.compile()


class BoardReview(L.Callback):
    """Pictures of the same few validation scenes during training, in TensorBoard and in `review/`.

    Args:
        every: of how many validations one is pictured.
        cases: how many of the first batch's scenes are shown, one above the other.
        baselines: training-free models shown beside ours.
    """

    def __init__(
        self, every: int = 1, cases: int = 2, baselines: Sequence[str] = ("backprojection", "sirt")
    ):
        self.every, self.cases, self.baselines = every, cases, tuple(baselines)
        self.n_validations = 0
        self._fixed: dict[str, Tensor] = {}
        self._shown: tuple[Any, Reconstruction] | None = None

    def on_fit_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Log the command line and the versions."""
        for board in _boards(trainer):
            lines = [f"    {name} {version}" for name, version in versions().items()]
            board.add_text(
                "text/run",
                "\n".join([f"    {' '.join(sys.argv)}", "", *lines]),
                trainer.global_step,
            )

    def on_validation_batch_end(
        self,
        trainer: L.Trainer,
        pl_module: L.LightningModule,
        outputs: Any,
        batch: Any,
        batch_idx: int,
        *_: Any,
    ) -> None:
        """Keep the first batch and its reconstruction."""
        if batch_idx == 0 and trainer.is_global_zero and not trainer.sanity_checking:
            self._shown = batch, outputs["out"]

    def on_validation_epoch_end(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Write the pictures at every `every`-th validation."""
        if self._shown is None or trainer.sanity_checking:
            return
        (batch, out), self._shown = self._shown, None
        self.n_validations += 1
        if (self.n_validations - 1) % self.every:
            return
        cases = [
            self._pictures(pl_module, batch, out, case)
            for case in range(min(self.cases, len(out.volume)))
        ]
        for name in cases[0]:
            image = montage.tiled([[pictures[name]] for pictures in cases])
            save_png(Path(trainer.default_root_dir) / "review" / f"{name}.png", image)
            for board in _boards(trainer):
                board.add_image(f"review/{name}", image, trainer.global_step, dataformats="HWC")

    def _pictures(
        self, module: Any, batch: Any, out: Reconstruction, case: int
    ) -> dict[str, Image]:
        truth, top, spacing = (
            batch["volume"][case, 0],
            module.hparams["data_range"],
            module.projector.grid.spacing,
        )
        volumes = {module.hparams["model"]["name"]: out.volume[case, 0]}
        volumes |= {name: v[case, 0] for name, v in self._baselines(module, batch["views"]).items()}
        support = (
            {} if out.support is None else {"support": outlined(truth, out.support[case, 0], top)}
        )
        predicted = module.projector(out.volume[case][None])[0, 0]
        shown = {
            "planes": montage.planes(truth, volumes | support, top, spacing),
            "mip": montage.projections(truth, volumes, top, spacing),
            "views": montage.views(batch["views"][case, 0], predicted),
        }
        if out.opinions is not None:
            shown["opinions"] = montage.opinions(out.opinions[case, :, 0], top, spacing)
        if out.weights is not None:
            shown["weights"] = montage.weights(out.weights[case, :, 0], spacing)
        if out.sigma is not None:
            error, sigma = out.volume[case, 0] - truth, out.sigma[case, 0]
            shown["uncertainty"] = montage.uncertainty(error, sigma, top, spacing)
        if (by := out.alignment) is not None:
            truth = batch["shift_px"][case] if "shift_px" in batch else None
            shown["cameras"] = cameras.alignments(by.shift_px[case], by.gain[case], truth)
        return shown

    def _baselines(self, module: Any, views: Tensor) -> dict[str, Tensor]:
        if not self._fixed:  # the scenes are the same at every review, so once is enough
            models = {
                name: MODELS.build(name, projector=module.projector).to(views.device)
                for name in self.baselines
            }
            self._fixed = {name: model(views).volume for name, model in models.items()}
        return self._fixed


def outlined(
    volume: Float[Tensor, "d h w"], mask: Bool[Tensor, "d h w"], value: float
) -> Float[Tensor, "d h w"]:
    """A volume with the outermost voxels of a mask set to a value; the grid's faces count as
    outside.
    """
    outside = pad((~mask).to(volume.dtype)[None, None], [1] * 6, value=1.0)
    rim = mask & (max_pool3d(outside, 3, stride=1)[0, 0] > 0)
    return torch.where(rim, value, volume)


def _boards(trainer: L.Trainer) -> list[Any]:
    return [
        logger.experiment for logger in trainer.loggers if isinstance(logger, TensorBoardLogger)
    ]
