"""Callbacks of a training: run time, memory, compilation, and pictures for TensorBoard."""

import sys
import time
from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import lightning.pytorch as L
import torch
from jaxtyping import Bool, Float
from lightning.pytorch.loggers import TensorBoardLogger
from torch import Tensor, nn
from torch.nn.functional import max_pool3d, pad
from torch.utils.checkpoint import checkpoint

from mvrecon.core.machine import peak, restarted_peak
from mvrecon.core.targets import check_places
from mvrecon.geometry.cameras.camera import Cameras
from mvrecon.methods.method import build_method
from mvrecon.methods.reconstruction import Reconstruction
from mvrecon.operators.operator import Projector
from mvrecon.report.metrics import volume_metrics
from mvrecon.report.viz import review, rig_mesh
from mvrecon.report.viz import rig as cameras
from mvrecon.report.viz.planes import Image
from mvrecon.training.export import file_name, save_png
from mvrecon.training.run_folder import versions

CONVOLUTIONS = (nn.Conv1d, nn.Conv2d, nn.Conv3d, nn.ConvTranspose2d, nn.ConvTranspose3d)


class Recompute(L.Callback):
    """Activation checkpointing: stores only what goes into each block of the networks, and computes
    the rest again for the gradients (Chen et al. 2016, arXiv:1604.06174).

    Same gradients in less memory; a step takes about a third longer.
    """

    def setup(self, trainer: L.Trainer, pl_module: Any, stage: str) -> None:
        """Replace the blocks' forward; names of parameters stay."""
        if stage == "fit":
            for block in blocks(pl_module.method):
                block.forward = partial(checkpoint, block.forward, use_reentrant=False)


def blocks(model: nn.Module) -> Iterator[nn.Module]:
    """The innermost modules with convolutions in them whose classes are not torch's own: of these
    it is sure that their forward is called.
    """
    inner = [block for child in model.children() for block in blocks(child)]
    torchs = type(model).__module__.startswith("torch.")
    convolves = not torchs and any(isinstance(module, CONVOLUTIONS) for module in model.modules())
    yield from inner or ([model] if convolves else [])


#: How TensorBoard draws the rig: in its own colours, from either side, without lights.
MATERIAL = {"material": {"cls": "MeshBasicMaterial", "side": 2}}


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
            pl_module.method.compile()


class BoardReview(L.Callback):
    """Sheets of the same few validation scenes during training, in TensorBoard and in `review/`, a
    card and a folder for each scene; and the rig, its rays and its grid in 3-D.

    Args:
        every: of how many validations one is pictured.
        cases: how many of the first batch's scenes are shown.
        baselines: training-free methods shown beside ours.
        label: of the method in the run's table; "": its class's name.
    """

    def __init__(
        self,
        every: int = 1,
        cases: int = 2,
        baselines: Sequence[str] = ("backprojection", "sirt"),
        label: str = "",
    ):
        self.label = label
        self.every, self.cases, self.baselines = every, cases, tuple(baselines)
        self.n_validations = 0
        self._fixed: list[dict[str, Tensor]] = []
        self._shown: tuple[Any, Reconstruction] | None = None

    def on_fit_start(self, trainer: L.Trainer, pl_module: Any) -> None:
        """Log the command line, the versions and the rig."""
        lines = [f"    {name} {version}" for name, version in versions().items()]
        text = "\n".join([f"    {' '.join(sys.argv)}", "", *lines])
        A = pl_module.projector
        for board in _boards(trainer):
            board.add_text("text/run", text, trainer.global_step)
            if isinstance(A.cameras, Cameras):
                rods = rig_mesh.mesh(rig_mesh.segments(A.cameras, A.grid))
                board.add_mesh(
                    "rig",
                    rods.vertices[None].float(),
                    colors=rods.colours[None],
                    faces=rods.faces[None],
                    config_dict=MATERIAL,
                    global_step=trainer.global_step,
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

    def on_validation_epoch_end(self, trainer: Any, pl_module: L.LightningModule) -> None:
        """Write the sheets at every `every`-th validation."""
        if self._shown is None or trainer.sanity_checking:
            return
        (batch, out), self._shown = self._shown, None
        self.n_validations += 1
        if (self.n_validations - 1) % self.every:
            return
        units = trainer.datamodule.unit, trainer.datamodule.unit_of_views
        for number in range(min(self.cases, len(out.volume))):
            name = file_name(batch["name"][number])
            folder = Path(trainer.default_root_dir) / "review" / name
            for kind, image in self._sheets(pl_module, batch, out, number, units).items():
                save_png(folder / f"{kind}.png", image)
                for board in _boards(trainer):
                    board.add_image(f"{kind}/{name}", image, trainer.global_step, dataformats="HWC")

    def _sheets(
        self, module: Any, batch: Any, out: Reconstruction, number: int, units: tuple[str, str]
    ) -> dict[str, Image]:
        truth, top = batch["volume"][number, 0], module.hparams["data_range"]
        A = module.operator(batch)
        case = review.Case(batch["name"][number], module.projector.grid, top, *units)
        scored = case._replace(name=f"{case.name}: PSNR in dB, SSIM")
        name = self.label or module.hparams["method"]["name"]
        label = named(name, out.volume[number], batch, number, top)
        volumes = {label: out.volume[number, 0], **self._baselines(A, batch, top)[number]}
        rim = None if out.support is None else outlined(truth, out.support[number, 0], top)
        predicted = A(out.volume)[number, 0]
        measured = batch["views"][number, 0]
        shown = {
            "planes": review.planes(scored, truth, volumes, rim),
            "mip": review.projections(scored, truth, volumes),
            "views": review.views(measured, predicted, case.name, case.unit_of_views),
        }
        if out.per_view is not None:
            shown["per_view"] = review.per_view(case, out.per_view[number, :, 0])
        if out.weights is not None:
            shown["weights"] = review.weights(case, out.weights[number, :, 0])
        if out.sigma is not None:
            error, sigma = out.volume[number, 0] - truth, out.sigma[number, 0]
            shown["uncertainty"] = review.uncertainty(case, error, sigma)
        if (by := out.alignment) is not None:
            known = batch["shift_px"][number] if "shift_px" in batch else None
            shown["cameras"] = cameras.alignments(by.shift_px[number], by.gain[number], known)
        return shown

    def _baselines(self, A: Projector, batch: Any, top: float) -> list[dict[str, Tensor]]:
        """Volumes of the baselines for each case, by name and figures."""
        if not self._fixed:  # the scenes are the same at every review, so once is enough
            views = batch["views"]
            self._fixed = [{} for _ in range(min(self.cases, len(views)))]
            for name in self.baselines:
                volumes = build_method({"name": name})(views, A).volume
                for number, shown in enumerate(self._fixed):
                    shown[named(name, volumes[number], batch, number, top)] = volumes[number, 0]
        return self._fixed


def named(
    name: str, volume: Float[Tensor, "1 d h w"], batch: Any, number: int, data_range: float
) -> str:
    """A method's name above its PSNR in dB and its SSIM for a case of a batch."""
    truth, inside = batch["volume"][number], batch["inside"][number]
    figures = volume_metrics(volume, truth, inside, data_range)
    return f"{name}\n{figures['psnr']:.2f}  {figures['ssim']:.3f}"


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
