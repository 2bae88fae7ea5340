"""Training, validation and test scenes of a run."""

import signal
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, TypedDict

import lightning.pytorch as L
import torch
from jaxtyping import Float
from torch import Tensor
from torch.utils.data import DataLoader

from mvrecon import __version__
from mvrecon.core.files.atomic import check_writable
from mvrecon.core.files.checks import from_home
from mvrecon.core.numbers import data_range_of
from mvrecon.core.options import parts_in
from mvrecon.core.parts import CAMERAS, REGISTRIES, SCENES, ProjectorPart, ScenePart
from mvrecon.core.quantities import NonNegativeInt, PositiveInt
from mvrecon.core.registry import from_options
from mvrecon.data import dataset, digests as sha256
from mvrecon.data.acquisition.acquired import Acquired
from mvrecon.data.acquisition.detector import Acquisition
from mvrecon.data.scenes.sample import Scene
from mvrecon.geometry.cameras.camera import Cameras
from mvrecon.geometry.grid import Grid


class Sizes(TypedDict, total=False):
    """Numbers of cases; a file may hold fewer."""

    train: NonNegativeInt
    val: NonNegativeInt
    test: NonNegativeInt


class CaseOptions(TypedDict, total=False):
    """Settings of the cases beside those of `Loading`.

    Args:
        sizes: numbers of training, validation and test cases.
        overlap: training, validation and test use the same first cases of a file.
    """

    sizes: Sizes
    overlap: bool


@dataclass(frozen=True)
class Loading:
    """Options of computing cases and loading batches.

    Args:
        batch_size: cases in a batch.
        workers: processes that compute the cases before training, and load batches.
        cache: folder that caches noiseless cases across runs; None: each run recomputes them. Cases
            of a run stay in memory either way, unless fresh.
        rigs: number of rigs for the training cases, of a camera with a `seed`, by the seeds after
            its own; 0: its own rig, as for validation and test.
        fresh: draw new training cases in every epoch: poses, errors of the views and noise. Volumes
            of a file are kept in memory, up to 2 GiB.

    Raises:
        ValueError: a number that is too small.
    """

    batch_size: PositiveInt = 2
    workers: NonNegativeInt = 0
    cache: Path | None = None
    rigs: NonNegativeInt = 0
    fresh: bool = False

    def __post_init__(self) -> None:
        if self.batch_size < 1 or min(self.workers, self.rigs) < 0:
            raise ValueError(
                f"Expected a batch_size of at least 1 and workers and rigs of at least 0, got "
                f"{self.batch_size}, {self.workers} and {self.rigs}"
            )


class DataState(TypedDict, total=False):
    """Epoch and position in it, and what the data are; empty before the training."""

    epoch: int
    seen: int
    cases: list[str]
    volumes: list[str]
    digests: dict[str, str]


#: Series of random cases. Validation and test are the same for all runs; a run's own seed gives its
#: training cases.
TEST_SERIES, VAL_SERIES, TRAIN_SERIES = 0, 1, 2
#: Parts of the data that each stage of Lightning needs.
STAGES = {"fit": ("train", "val"), "validate": ("val",), "test": ("test",), "predict": ("test",)}


class SceneData(L.LightningDataModule):
    """The data of a run, from plain dicts of names and numbers.

    Random scenes draw training, validation and test cases from different series. A scene from a
    file validates on its last `val` cases and trains on those before; test cases come from the test
    scene, or are the first fifth if that is the same file. No case is in two sets, unless with
    `overlap`.

    Args:
        scenes: name and options of the scenes "train" and "test".
        measurement: `grid`, options of `Grid.centred`, in the order (x, y, z); `camera`, name and
            options of the rig; `projector`, name and options of the views' operator, None: line
            integrals; `acquisition`, options of `Acquisition`, None: a perfect detector.
        sizes: the number of cases for "train", "val" and "test"; a file may hold fewer.
        overlap: training, validation and test use the same first cases of a file, as for a file
            with one volume.
        seed: seed of the training cases and their order.
        loading: options of `Loading`.

    Raises:
        TypeError: an unknown option of the acquisition or of loading; a data range that is not a
            number.
        ValueError: sizes without training cases, scenes of different data range, or of one that is
            not positive and finite, a number that is too small.
        OSError: `cache` is a file, or a folder that cannot be written.
    """

    def __init__(
        self,
        scenes: Mapping[str, ScenePart],
        measurement: Mapping[str, Any],
        sizes: Mapping[str, int],
        overlap: bool = False,
        seed: int = 0,
        **loading: Any,
    ):
        super().__init__()
        if missing := {"train", "val", "test"} ^ set(sizes):
            raise ValueError(
                f"sizes must give train, val and test; missing or unknown: "
                f"{', '.join(sorted(missing))}"
            )
        if min(sizes.values()) < 0 or seed < 0:
            raise ValueError(
                f"Expected sizes and seed of at least 0, got sizes {dict(sizes)}, seed {seed}"
            )
        self.grid = Grid.centred(**measurement["grid"])
        self.cameras: Cameras = CAMERAS.from_config(measurement["camera"])
        self.projector = measurement.get("projector")
        self.acquisition = Acquisition.of(measurement.get("acquisition"))
        self.sizes, self.loading = dict(sizes), from_options(Loading, "data", loading)
        if self.loading.cache is not None:
            check_writable(from_home(self.loading.cache) / "case.h5")
        self.overlap, self.seed = overlap, seed
        self.rigs = dataset.training_rigs(measurement["camera"], self.loading.rigs)
        self._settings = {key: dict(scenes[key]) for key in ("train", "test")}
        self.scenes: dict[str, Scene] = {
            key: SCENES.from_config(scene) for key, scene in self._settings.items()
        }
        ranges = {key: data_range_of(scene.data_range) for key, scene in self.scenes.items()}
        if ranges["train"] != ranges["test"]:
            raise ValueError(
                f"The training and the test scene must share their data_range, got {ranges}"
            )
        first, second = self._settings.values()
        given = [scene.get("path") for scene in (first, second)]
        paths = [Path(path).resolve() for path in given if path is not None]
        one_file = len(paths) == 2 and paths[0] == paths[1]
        self.shared = first == second or one_file
        self._files = {
            key: list(sha256.files_in([each, self.projector]))
            for key, each in self._settings.items()
        }
        self._digests: dict[str, str] = {}
        self.sets: dict[str, dataset.SceneDataset | dataset.ManyRigs] = {}
        self._order: dataset.EpochOrder | None = None
        self._volumes: list[str] | None = None

    @property
    def data_range(self) -> float:
        """The fixed range of values for PSNR and SSIM."""
        return self.scenes["test"].data_range

    @property
    def unit(self) -> str:
        """Unit of the volumes' values."""
        return self.scenes["test"].unit

    @cached_property
    def unit_of_views(self) -> str:
        """Unit of the views' values."""
        return self._measured("train").unit_of_views(self.grid, self.cameras)

    def indices(self, part: str) -> list[int]:
        """The cases of "train", "val" or "test".

        Raises:
            ValueError: a file with too few cases for the sizes.
        """
        scene, size = self.scenes["test" if part == "test" else "train"], self.sizes[part]
        if scene.length is None:
            return list(range(size))
        if self.overlap or (part == "test" and not self.shared):
            return _turns(scene, size, range(scene.length), part == "train")
        # a fifth whatever `test` is, as a checkpoint may be older than this `test`
        n_test = scene.length // 5 if self.sizes["train"] else scene.length
        first, last = n_test * self.shared, scene.length - self.sizes["val"]
        if last < first or (size and not {"train": last - first, "val": size, "test": first}[part]):
            raise ValueError(
                f"A scene with {scene.length} case(s) cannot be split: {first} to test (a fifth), "
                f"the last {self.sizes['val']} to validate, {max(0, last - first)} to train; "
                f"expected some for each that data.sizes asks for, such as data.sizes.val=1, or "
                f"test_scene=volumes; data.overlap=true takes the same cases for all"
            )
        if part == "test":
            return list(range(min(size, first)))
        if part == "val":
            return list(range(last, scene.length))
        return _turns(scene, size, range(first, last), True)

    def setup(self, stage: str | None = None) -> None:
        """Compute the cases of a stage unless they exist."""
        rank, world = self._share
        for part in STAGES[stage] if stage else ("train", "val", "test"):
            if part in self.sets:
                continue
            series = {"train": TRAIN_SERIES + self.seed, "val": VAL_SERIES, "test": TEST_SERIES}[
                part
            ]
            measured = self._measured("test" if part == "test" else "train")
            if part == "train" and self.loading.fresh:
                measured.store = None  # its cases never return
            indices, batch = self.indices(part), self.loading.batch_size * world
            fresh = self._fresh(indices) if part == "train" else 0
            if part == "train" and self.rigs:
                made = dataset.ManyRigs(
                    measured, self.grid, self.rigs, indices, series, batch, fresh
                )
            else:
                made = dataset.SceneDataset(
                    measured, self.grid, self.cameras, indices, series, fresh=fresh
                )
            made.prepare(f"{part} cases", self.loading.workers)
            self.sets[part] = made
        if (cases := self.sets.get("train")) is not None:
            rigs = (
                (len(cases.parts), cases.together) if isinstance(cases, dataset.ManyRigs) else None
            )
            self._order = dataset.EpochOrder(
                len(cases), self.seed, rank, world, rigs, self.loading.fresh
            )

    def first_volumes(self, count: int = 4) -> list[Float[Tensor, "d h w"]]:
        """The first true volumes of the training and test cases that are computed."""
        made = [self.sets[part].prepare() for part in ("train", "test") if part in self.sets]
        return [volume[0] for cases in made for volume in cases.get("volume", ())[:count]]

    def _fresh(self, indices: Sequence[int]) -> int:
        """Increment of training cases' indices from epoch to epoch.

        Raises:
            ValueError: fresh cases of a scene with fixed ones.
        """
        if not self.loading.fresh:
            return 0
        scene = self.scenes["train"]
        if scene.length is None:
            return len(indices)
        if not scene.vary:
            raise ValueError(
                "Expected random cases for data.fresh=true, such as scene.vary=true, got a scene "
                "whose cases are the same in every epoch"
            )
        scene.keeps = True
        return (max(indices, default=0) // scene.length + 1) * scene.length

    @property
    def _share(self) -> tuple[int, int]:
        """Rank of this process in training, and number of processes."""
        return (self.trainer.global_rank, self.trainer.world_size) if self.trainer else (0, 1)

    def _measured(self, key: str) -> Acquired:
        """The scene "train" or "test" with its detector and cache."""
        scene, store = self.scenes[key], None
        if self.loading.cache is not None:
            digests = self.digests(key)
            settings = {"scene": self._settings[key], "projector": self.projector}
            parts = parts_in(settings["scene"], ScenePart)
            parts += parts_in(self.projector or {}, ProjectorPart)
            # a factory may be of a plugin, and what it builds of mvrecon
            makers = [REGISTRIES[kind].get(node["name"]) for _, kind, node in parts]
            made_of = {
                "version": __version__,
                "code": sha256.of_parts(type(scene), *makers),
                **settings,
                "files": {path: digests[path] for path in self._files[key]},
                "fine": self.acquisition.fine,
                "rays": self.acquisition.rays,
                "closed_form": self.acquisition.closed_form,
            }
            store = dataset.CaseStore(self.loading.cache, made_of, scene)
        return Acquired(scene, self.projector, self.acquisition, store)

    def train_dataloader(self) -> DataLoader[dataset.Case]:
        """Training batches, in a new random order in every epoch."""
        return self._loader("train", self._order)

    def val_dataloader(self) -> DataLoader[dataset.Case]:
        """Validation batches; with several processes, this one's share, see `shared`."""
        return self._loader("val", dataset.shared(len(self.sets["val"]), *self._share))

    def test_dataloader(self) -> DataLoader[dataset.Case]:
        """Test batches."""
        return self._loader("test")

    predict_dataloader = test_dataloader

    def transfer_batch_to_device(
        self, batch: Any, device: torch.device, dataloader_idx: int
    ) -> Any:
        """Move a batch to the device; the number of its rig stays on the host."""
        moved = super().transfer_batch_to_device(batch, device, dataloader_idx)
        return {**moved, "rig": batch["rig"]} if "rig" in batch else moved

    def _loader(
        self, part: str, order: dataset.EpochOrder | range | None = None
    ) -> DataLoader[dataset.Case]:
        # without a generator each epoch would draw from the global one
        own = order.generator if isinstance(order, dataset.EpochOrder) else torch.Generator()
        return DataLoader(
            self.sets[part],
            self.loading.batch_size,
            sampler=order,
            num_workers=self.loading.workers,
            worker_init_fn=_ignore_sigterm,
            persistent_workers=self.loading.workers > 0,
            pin_memory=torch.cuda.is_available(),
            generator=own,
        )

    def digests(self, *parts: str, rig: bool = True) -> dict[str, str]:
        """SHA-256 of the rig, unless `rig` is false, and by path of every file that the scenes of
        `parts` ("train", "test") read.
        """
        paths = sorted({path for part in parts for path in self._files[part]})
        self._digests |= {path: sha256.of_file(path) for path in paths if path not in self._digests}
        own = {sha256.RIG_KEY: sha256.of_rig(self.cameras)} if rig else {}
        return own | {path: self._digests[path] for path in paths}

    def state_dict(self) -> DataState:
        """State for a checkpoint: epoch and position in it, names of the training cases, digests of
        their volumes, of the rig and of the files.
        """
        loop = self.trainer.fit_loop if self.trainer else None
        if loop is None or self._order is None:
            return {}
        n_batches = int(loop.epoch_loop.batch_progress.current.processed)  # pyrefly: ignore[missing-attribute]
        n_done = n_batches * self.loading.batch_size * self._order.world
        assert self.trainer is not None
        whole = n_batches >= self.trainer.num_training_batches  # resume with the next epoch
        cases = self.sets["train"].prepare()
        if self._volumes is None:
            self._volumes = [sha256.of_volume(volume) for volume in cases.get("volume", ())]
        return {
            "epoch": self._order.epoch + whole,
            "seen": 0 if whole else n_done,
            "cases": list(cases["name"]),
            "volumes": self._volumes,
            "digests": self.digests("train"),
        }

    def load_state_dict(self, state_dict: DataState) -> None:
        """Resume from a checkpoint with the unused cases of the interrupted epoch.

        Raises:
            Refused: the rig or a file has changed since.
        """
        if self._order is not None and state_dict:
            sha256.compare(self.digests("train"), state_dict.get("digests", {}), "the checkpoint")
            self._order.resume(state_dict["epoch"], state_dict["seen"])
            # Lightning looks for this at the loader, where it is not
            warnings.filterwarnings(
                "ignore", ".*ended before the epoch ended and your dataloader is not resumable"
            )


def _ignore_sigterm(worker: int) -> None:
    """A scheduler sends SIGTERM to every process of a job; this one ends with the trainer, which
    writes a checkpoint first.
    """
    signal.signal(signal.SIGTERM, signal.SIG_IGN)


def _turns(scene: Scene, size: int, cases: range, vary: bool) -> list[int]:
    """The first `size` cases of a range; with `vary`, more of them are varied copies of
    the range.
    """
    n = len(cases)
    count = size if vary and scene.vary else min(size, n)
    return [i // n * (scene.length or 0) + cases[i % n] for i in range(count)]
