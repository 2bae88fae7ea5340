"""A run in TensorBoard: sheets of validation scenes during training; finally the settings and
figures of every method, the result table, and test scenes slice by slice.
"""

import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import lightning.pytorch as L
import torch
from jaxtyping import Bool, Float
from lightning.pytorch.loggers import TensorBoardLogger
from torch import Tensor
from torch.nn.functional import max_pool3d, pad

from mvrecon.core.files.runs import Results, flatten
from mvrecon.core.quantities import NonNegativeInt, PositiveInt
from mvrecon.data.acquisition.disturbances import RigErrors
from mvrecon.data.dataset import Batch
from mvrecon.geometry.cameras.camera import Cameras
from mvrecon.geometry.grid import Grid
from mvrecon.methods.method import Reconstruction, build_method
from mvrecon.operators.operator import Projector
from mvrecon.report.comparison import Cells, cells, markdown, rows_of
from mvrecon.report.metrics import volume_metrics
from mvrecon.report.viz import review, rig
from mvrecon.report.viz.images import Image, save_png
from mvrecon.training.callbacks import TensorBoard, is_tensorboard
from mvrecon.training.export import file_name
from mvrecon.training.run_folder import versions
from mvrecon.training.settings import TrainSettings

#: Folder of pictures in a run folder.
REVIEW_FOLDER = "review"
#: TensorBoard's rendering of the rig: own colours, both sides, no lights.
MESH_MATERIAL = {"material": {"cls": "MeshBasicMaterial", "side": 2}}


class TensorBoardReview(L.Callback):
    """Sheets of the same few validation scenes during training, in TensorBoard and in `review/`, a
    card and a folder for each scene; and the rig, its rays and its grid in 3-D.

    Args:
        every: number of validations between sheets.
        cases: number of scenes, from the first batch.
        baselines: training-free methods for comparison.
    """

    label = ""  # of the method in the run's table; "": its class's name

    def __init__(
        self,
        every: PositiveInt = 1,
        cases: NonNegativeInt = 2,
        baselines: Sequence[str] = ("backprojection", "sirt"),
    ):
        self.every, self.cases, self.baselines = every, cases, tuple(baselines)
        self.n_validations = 0
        self._fixed: list[dict[str, Tensor]] = []
        self._shown: tuple[Any, Reconstruction] | None = None

    def on_fit_start(self, trainer: L.Trainer, pl_module: Any) -> None:
        """Log the command line, the versions and the rig."""
        lines = [f"    {name} {version}" for name, version in versions().items()]
        text = "\n".join([f"    {' '.join(sys.argv)}", "", *lines])
        A = pl_module.projector
        for writer in _writers(trainer):
            writer.add_text("text/run", text, trainer.global_step)
            if isinstance(A.cameras, Cameras):
                rods = rig.mesh(rig.segments(A.cameras, A.grid))
                writer.add_mesh(
                    "rig",
                    rods.vertices[None].float(),
                    colors=rods.colours[None],
                    faces=rods.faces[None],
                    config_dict=MESH_MATERIAL,
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
            folder = Path(trainer.default_root_dir) / REVIEW_FOLDER / name
            for kind, image in self._sheets(pl_module, batch, out, number, units).items():
                save_png(folder / f"{kind}.png", image)
                for writer in _writers(trainer):
                    writer.add_image(
                        f"{kind}/{name}", image, trainer.global_step, dataformats="HWC"
                    )

    def _sheets(
        self, module: Any, batch: Any, out: Reconstruction, number: int, units: tuple[str, str]
    ) -> dict[str, Image]:
        truth, top = batch["volume"][number, 0], module.hparams["data_range"]
        A = module.operator(batch)
        case = review.CaseSheets(batch["name"][number], module.projector.grid, top, *units)
        case = case.about(truth, module.projector.cameras)
        scored = case._replace(name=f"{case.name}: PSNR in dB, SSIM")
        name = self.label or module.hparams["method"]["name"]
        label = named(name, out.volume[number], batch, number, top)
        volumes = {label: out.volume[number, 0], **self._baselines(A, batch, top)[number]}
        rim = None if out.support is None else outlined(truth, out.support[number, 0], top)
        predicted = A(out.volume)[number, 0]
        measured = batch["views"][number, 0]
        rays = None if out.ray_weights is None else out.ray_weights[number, 0]
        shown = {
            "planes": review.planes(scored, truth, volumes, rim),
            "mip": review.projections(scored, truth, volumes),
            "views": review.views(measured, predicted, case.name, case.unit_of_views, rays),
        }
        if len(measured) > review.MAX_CAMERAS:
            shown["mosaic"] = review.mosaic(measured, case.name, case.unit_of_views)
        if out.per_view is not None:
            shown["per_view"] = review.per_view(case, out.per_view[number, :, 0])
        if out.weights is not None:
            shown["weights"] = review.weights(case, out.weights[number, :, 0])
        if out.sigma is not None:
            error, sigma = out.volume[number, 0] - truth, out.sigma[number, 0]
            shown["uncertainty"] = review.uncertainty(case, error, sigma)
        if (by := out.alignment) is not None:
            known = None
            if "shift_px" in batch:
                errors, shown_on = RigErrors.of(batch, number), module.projector
                known = errors.image_shift(shown_on.cameras, truth, shown_on.grid)
            shown["cameras"] = review.alignments(by.shift_px[number], by.gain[number], known)
        return shown

    def _baselines(self, A: Projector, batch: Any, top: float) -> list[dict[str, Tensor]]:
        """Volumes of the baselines for each case, by name and figures."""
        if not self._fixed:  # the scenes are the same at every review
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
    """Set the outermost voxels of a mask to a value; outside of the grid counts as outside the
    mask.
    """
    outside = pad((~mask).to(volume.dtype)[None, None], [1] * 6, value=1.0)
    rim = mask & (max_pool3d(outside, 3, stride=1)[0, 0] > 0)
    return torch.where(rim, value, volume)


def _writers(trainer: L.Trainer) -> list[Any]:
    return [
        logger.experiment for logger in trainer.loggers if isinstance(logger, TensorBoardLogger)
    ]


#: Settings without effect on results, or replaced by `method`.
IGNORED_SETTINGS = "name resume plugins callbacks logger compare method label".split()
#: Figures of the table by their names in the results; costs, and theirs.
TABLE_FIGURES = ("psnr", "ssim", "view_nrmse")
TABLE_COSTS = {"ms": "ms_per_volume", "peak_mb": "peak_mb", "train_seconds": "train_seconds"}
#: Subfolder of the test's events, and of its pictures.
TEST_FOLDER = "test"
#: Maximum number of test scenes, and of slices of each.
MAX_CASES, MAX_SLICES = 2, 16


def log_results(
    folder: Path, settings: TrainSettings, table: Results, overrides: Sequence[str]
) -> None:
    """Log settings and test figures of the main method and of every other trained one, the result
    table and the run's overrides, if the run uses TensorBoard.

    Settings have their command-line names, such as camera.n_views; `run` is the folder's name,
    method.name a class, which may have several labels. TensorBoard lists those that differ between
    runs first. It also shows all other numbers of a folder, so the test has its own.
    """
    if not any(map(is_tensorboard, (settings.logger or {}).values())):
        return
    shared = {key: value for key, value in vars(settings).items() if key not in IGNORED_SETTINGS}
    labelled = settings.methods()
    main = next(iter(labelled))
    for label, method in labelled.items():
        row: Any = table["methods"][label]
        if label != main and not row["train_steps"]:  # the same in every run
            continue
        logger = TensorBoard(str(folder / label / TEST_FOLDER))
        figures = {f"test/{name}": row[name]["mean"] for name in TABLE_FIGURES}
        costs = {
            f"test_costs/{name}": row[key]
            for name, key in TABLE_COSTS.items()
            if row[key] is not None
        }
        settled = {"run": folder.name, "label": label, "method": method}
        values = {
            ".".join(keys): v if isinstance(v, bool | int | float | str) else str(v)
            for keys, v in flatten(settled | shared)
        }
        logger.log_session(values, figures | costs)
        if label == main:
            rows = list(rows_of(table, settings.name, folder))
            head, body = cells(rows, rows[0])
            narrow = Cells(head[1:], [line[1:] for line in body])  # of this run alone
            logger.experiment.add_text("text/results", markdown(narrow))
            lines = [f"    {line}" for line in overrides] or ["none"]
            logger.experiment.add_text("text/overrides", "\n".join(lines))
        logger.finalize("success")


class Slices:
    """Logs the first test scenes slice by slice in the main method's TensorBoard events: the
    slider's steps are the slices from feet to head; the last step, which a card shows first,
    repeats the middle slice, which is also written to `review/test`.

    Args:
        folder: folder of the run.
        settings: settings of the run; nothing is logged without TensorBoard.
        grid: grid of the volumes.
        data_range: range of the values.
        unit: unit of the values.
    """

    def __init__(
        self, folder: Path, settings: TrainSettings, grid: Grid, data_range: float, unit: str
    ):
        self.folder, self.label = folder, next(iter(settings.methods()))
        self.case = review.CaseSheets("", grid, data_range, unit)
        shown = any(map(is_tensorboard, (settings.logger or {}).values()))
        self.left = MAX_CASES if shown else 0

    def __call__(self, scene: Batch, volumes: Mapping[str, Tensor]) -> None:
        """Log a scene and its reconstructions by label, up to the maximum number of scenes."""
        if not self.left:
            return
        self.left -= 1
        truth, case = scene["volume"][0, 0], self.case._replace(name=scene["name"][0])
        shown = {
            named(label, volume[0], scene, 0, case.data_range): volume[0, 0]
            for label, volume in volumes.items()
        }
        logger = TensorBoard(str(self.folder / self.label / TEST_FOLDER))
        distance, tag = -(-len(truth) // MAX_SLICES), f"slices/{file_name(case.name)}"
        levels = range(distance // 2, len(truth), distance)
        middle = levels[len(levels) // 2]
        for step, z in (*zip(levels, levels, strict=True), (len(truth), middle)):
            image = review.slices(case, truth, shown, z)
            logger.experiment.add_image(tag, image, step, dataformats="HWC")
        logger.finalize("success")
        save_png(self.folder / REVIEW_FOLDER / TEST_FOLDER / f"{file_name(case.name)}.png", image)
