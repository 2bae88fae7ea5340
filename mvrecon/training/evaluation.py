"""The result table: figures of merit of every method on the same test scenes, and scenes seen in
training.
"""

import math
import statistics
import time
import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from itertools import chain
from pathlib import Path
from typing import Any, cast

import torch
from torch import Tensor, nn
from torch.utils.data import DataLoader

from mvrecon.core.files.runs import MethodRow, Results
from mvrecon.core.machine import peak_since, restarted_peak
from mvrecon.core.numbers import data_range_of
from mvrecon.core.parts import METRICS, Options
from mvrecon.data import digests
from mvrecon.data.dataset import Batch, single_cases
from mvrecon.data.module import SceneData
from mvrecon.methods.method import Reconstruction
from mvrecon.operators.operator import Projector
from mvrecon.report import metrics
from mvrecon.report.cameras import camera_row, cameras_of
from mvrecon.report.quality import Score, quality_of, quality_row
from mvrecon.training.checkpoints import finished
from mvrecon.training.fit import build_module, trainable
from mvrecon.training.module import build_projector
from mvrecon.training.settings import TrainSettings
from mvrecon.training.trained import Trained, load_checkpoint

#: Of each case, by the label of a method.
Scores = dict[str, list[Score]]
#: Units of a method's costs.
COST_UNITS = {"ms_per_volume": "ms", "peak_mb": "2^20 bytes", "train_seconds": "s"}

SceneCallback = Callable[[Batch, dict[str, Tensor]], None]


@torch.inference_mode()
def evaluate(
    methods: Mapping[str, nn.Module],
    batches: Iterable[Batch],
    A: Projector,
    data_range: float,
    device: str = "cpu",
    on_scene: SceneCallback | None = None,
    assumed: Mapping[str, Projector] | None = None,
) -> Scores:
    """Evaluate methods on scenes: figures of merit (nan for a failed volume, see `case_metrics`,
    and of a method that raises on a later scene than the first),
    time and memory of one reconstruction ("ms"; "bytes", on a CPU of the first scene only, else
    None), a method's own error estimates ("quality") and its estimates of the cameras ("cameras",
    if any).

    Args:
        methods: the methods by label.
        batches: test scenes, in batches of any size; the methods get them one by one.
        A: the operator of the views.
        data_range: range of the true values, for PSNR and SSIM.
        device: device of the methods.
        on_scene: called with every scene and its reconstructions by label.
        assumed: operators, by label, of methods that assume another one than A.

    Warns:
        UserWarning: a method raises on a later scene.

    Raises:
        TypeError, ValueError: a data range that is not a positive and finite number.
        Exception: what a method raises on the first scene.
    """
    data_range = data_range_of(data_range)
    A, others = A.to(device), {k: B.to(device) for k, B in (assumed or {}).items()}
    ready = {label: method.to(device).eval() for label, method in methods.items()}
    scores: Scores = {label: [] for label in methods}
    for case in chain.from_iterable(map(single_cases, batches)):
        scene: Any = {k: v.to(device) if isinstance(v, Tensor) else v for k, v in case.items()}
        volumes, of_case = {}, A.for_case(scene)
        for label, method in ready.items():
            B = others[label].for_case(scene) if label in others else of_case
            needed = None
            if not scores[label]:
                method(scene["views"], B)  # the first call compiles and fills caches
                needed = _needed_on_cpu(method, scene["views"], B)
            try:
                milliseconds, on_gpu, out = _measured(method, scene["views"], B)
            except Exception as error:
                if not scores[label]:
                    raise
                warnings.warn(
                    f"{label} failed on {scene['name'][0]}, {type(error).__name__}: {error}",
                    stacklevel=2,
                )
                failed = Reconstruction(torch.full_like(scene["volume"], math.nan))
                milliseconds, on_gpu, out = math.nan, None, failed
            volume, needed = out.volume, needed if on_gpu is None else on_gpu
            figures = metrics.case_metrics(volume[0], of_case(volume)[0], scene, data_range)
            costs = {"ms": milliseconds, "bytes": needed, "quality": quality_of(out, scene)}
            score: Any = {**figures, **costs, **cameras_of(out.alignment, scene)}
            scores[label].append(score)
            volumes[label] = volume
        if on_scene is not None:
            on_scene(scene, volumes)
    return scores


def _method(
    settings: TrainSettings, folder: Path, label: str, model: Options, data_range: float
) -> Trained:
    """A method of a run, from its checkpoint, or newly built if it has no trainable weights.

    Raises:
        FileNotFoundError: its training has not finished.
    """
    path = finished(folder, label)
    fresh = None if path.exists() else build_module(settings, model, data_range)
    return load_checkpoint(path) if fresh is None or trainable(fresh) else Trained(fresh, 0.0, 0)


@dataclass(frozen=True)
class Loaded:
    """What a run is evaluated with.

    Args:
        trained: methods of the run by label.
        A: operator of the views.
        assumed: operators, by label, of methods that assume another one.
    """

    trained: dict[str, Trained]
    A: Projector
    assumed: dict[str, Projector]


def loaded(
    settings: TrainSettings, folder: Path, data: SceneData, other_rig: bool = False
) -> Loaded:
    """Load the methods of a run and build their operators, and compute the test cases of `data`.

    Args:
        settings: settings of the run, or of an evaluation.
        folder: folder of the run.
        data: data with the test scenes.
        other_rig: allow another rig and grid, those of `settings`, than in training.

    Raises:
        FileNotFoundError: training of a method has not finished.
        Refused: a method trained with another rig without `other_rig`, or with other contents of a
            file.
    """
    geometry, trained, assumed = (settings.grid, settings.camera), {}, {}
    for label, model in settings.methods().items():
        one = trained[label] = _method(settings, folder, label, model, data.data_range)
        known = data.digests("test", rig=not other_rig)
        digests.compare(known, one.digests, finished(folder, label))
        projector = one.module.hparams["geometry"]["projector"]
        if projector != settings.projector:
            assumed[label] = build_projector(*geometry, projector)
    data.setup("test")
    return Loaded(trained, build_projector(*geometry, settings.projector), assumed)


def results(
    settings: TrainSettings,
    folder: Path,
    data: SceneData,
    device: str = "cpu",
    on_scene: SceneCallback | None = None,
    ready: Loaded | None = None,
) -> Results:
    """Compute the result table of a run: its checkpoints evaluated on the test scenes of `data`.

    Args:
        settings, folder, data: see `loaded`.
        device: device of the methods.
        on_scene: called with every scene and its reconstructions by label.
        ready: what `loaded` returns; None: load it.

    Raises:
        ValueError: weights that do not fit the rig or the grid; and as `loaded`.
    """
    ready = ready or loaded(settings, folder, data)
    trained = ready.trained
    methods = {label: one.module.method for label, one in trained.items()}
    names: list[str] = []
    truths: list[str] = []
    sizes: list[list[float]] = []

    def watch(scene: Batch, volumes: dict[str, Tensor]) -> None:
        names.extend(scene["name"])
        truths.extend(digests.of_volume(truth) for truth in scene["volume"])
        sizes.extend(metrics.mean_and_rms(truth) for truth in scene["volume"])
        if on_scene is not None:
            on_scene(scene, volumes)

    batches = data.test_dataloader()
    scores = evaluate(methods, batches, ready.A, data.data_range, device, watch, ready.assumed)
    return {
        "name": settings.name,
        "seed": settings.seed,
        "scene": settings.test_scene or settings.scene,
        "scenes": names,
        "truths": sizes,
        "grid": {"shape": list(data.grid.shape), "affine": data.grid.affine.tolist()},
        "seen_in_training": seen_in_training(trained.values(), names, truths),
        "overlap": data.overlap and data.scenes["test"].length is not None,
        "projector": settings.projector,
        "acquisition": asdict(data.acquisition),
        "data_range": data.data_range,
        "device": device,
        "threads": torch.get_num_threads(),
        "units": {
            **{name: metrics.declared(name).unit for name in METRICS.names()},
            **COST_UNITS,
            "data_range": data.unit,
        },
        "methods": {label: _row(method, scores[label], names) for label, method in trained.items()},
    }


def validation_psnr(
    settings: TrainSettings, folder: Path, data: SceneData, device: str = "cpu"
) -> float:
    """Return the mean PSNR in dB of a run's main method on the validation scenes, for choosing
    settings; nan without scenes, minus infinity if a volume has failed.

    Raises:
        FileNotFoundError: its training has not finished.
    """
    data.setup("validate")
    label, model = next(iter(settings.methods().items()))
    module = _method(settings, folder, label, model, data.data_range).module
    batches = DataLoader(data.sets["val"])
    methods = {label: module.method}
    scores = evaluate(methods, batches, module.projector, data.data_range, device)
    values = [score["psnr"] for score in scores[label]]
    return -math.inf if any(map(math.isnan, values)) else metrics.mean_and_spread(values)["mean"]


def _row(method: Trained, scores: list[Score], names: Sequence[str]) -> MethodRow:
    failed = [n for n, score in zip(names, scores, strict=True) if math.isnan(score["nrmse"])]
    needed = [score["bytes"] for score in scores if score["bytes"] is not None]
    figures = {
        name: metrics.mean_and_spread([cast(float, score[name]) for score in scores], bool(failed))
        for name in METRICS.names()
    }
    row: Any = {
        "parameters": sum(p.numel() for p in method.module.method.parameters() if p.requires_grad),
        "train_steps": method.steps,
        "train_seconds": method.seconds,
        "ms_per_volume": statistics.median(
            [score["ms"] for score in scores if not math.isnan(score["ms"])]
        ),
        "peak_mb": max(needed) / 2**20 if needed else None,
        "failed": failed,
        **figures,
        **quality_row(scores),
        **camera_row(scores),
    }
    return row


def seen_in_training(
    methods: Iterable[Trained], names: Sequence[str], truths: Sequence[str] = ()
) -> list[str] | None:
    """Return the names of scenes on which any method was trained; None if a checkpoint does not
    store its training cases.

    Args:
        methods: methods of the run.
        names: names of the scenes.
        truths: digests of their volumes, which identify training cases under any name.
    """
    trained = [method for method in methods if method.steps]
    if any(method.cases is None for method in trained):
        return None
    cases = {case for method in trained for case in method.cases or ()}
    volumes = {volume for method in trained for volume in method.volumes}
    known = truths or [""] * len(names)
    pairs = zip(names, known, strict=True)
    return [name for name, truth in pairs if name in cases or truth in volumes]


def _measured(
    method: nn.Module, views: Tensor, A: Projector
) -> tuple[float, int | None, Reconstruction]:
    """Milliseconds of one reconstruction, additional bytes on a GPU, else None, and its result."""
    before = torch.cuda.memory_allocated() if views.is_cuda else 0
    if views.is_cuda:
        torch.cuda.reset_peak_memory_stats()
    start = time.perf_counter()
    out = method(views, A)
    if views.is_cuda:
        torch.cuda.synchronize()
    milliseconds = 1e3 * (time.perf_counter() - start)
    needed = torch.cuda.max_memory_allocated() - before if views.is_cuda else None
    return milliseconds, needed, out


def _needed_on_cpu(method: nn.Module, views: Tensor, A: Projector) -> int | None:
    """Additional bytes of one reconstruction on a CPU; None on a GPU, and except on Linux. The call
    is slower than others, as its memory is new.
    """
    if views.is_cuda or (start := restarted_peak(trimmed=True)) is None:
        return None
    method(views, A)
    return peak_since(start)
