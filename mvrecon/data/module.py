"""Training, validation and test scenes of a run."""

import hashlib
import json
import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields
from functools import cached_property
from pathlib import Path
from typing import Any

import h5py
import lightning.pytorch as L
import torch
from torch.utils.data import DataLoader

from mvrecon import __version__
from mvrecon.core.files.atomic import written_whole
from mvrecon.core.files.checks import Refused, blaming
from mvrecon.core.parts import CAMERAS, SCENES
from mvrecon.core.quantities import NonNegativeInt, PositiveInt
from mvrecon.core.registry import check_options
from mvrecon.data import digests as sha256
from mvrecon.data.acquisition.acquired import Acquired
from mvrecon.data.acquisition.detector import Acquisition
from mvrecon.data.dataset import EpochOrder, ManyRigs, RigOrder, SceneDataset, shared, training_rigs
from mvrecon.data.digests import of_grid, of_rig
from mvrecon.data.hdf5 import reading
from mvrecon.data.scenes.sample import Sample, Scene
from mvrecon.data.storage import dataset_in
from mvrecon.geometry.cameras.camera import Cameras
from mvrecon.geometry.grid import Grid

#: Raised where what a scene, a projector or a file of this store is has changed: older files are
#: not read.
VERSION = 1


class CaseStore:
    """A folder of cases as a perfect detector measures them, in a file each.

    A file is known by a SHA-256 digest of all that its case depends on: what `made_of` says, index,
    seed, grid and rig. What a detector adds, and gains that drifted, are not in it. Files are
    written whole or not at all, so several runs may share a folder; a file that is damaged is made
    anew.

    Args:
        folder: of the files; it is made.
        made_of: settings of scene and projector and digests of their files, as JSON has them.
        scene: its `seed_of(index, seed)` says on which seed a case depends.
    """

    def __init__(self, folder: str | Path, made_of: Mapping[str, Any], scene: Scene):
        self.folder, self.made_of = Path(folder), json.dumps(made_of, sort_keys=True)
        self.scene = scene

    def __call__(
        self, index: int, seed: int, grid: Grid, cameras: Any, make: Callable[[], Sample]
    ) -> Sample:
        """The case that is kept, or else the one that `make` makes, kept from now on.

        Explicit rays have no digest: their cases are not kept.

        Raises:
            OSError: the folder cannot be written.
        """
        if not isinstance(cameras, Cameras):
            return make()
        path = self.path(index, seed, grid, cameras)
        if path.exists():
            try:
                return _read(path, grid, cameras)
            except Refused:  # cut short or damaged: the case can be made again
                pass
        sample = make()
        _write(path, sample)
        return sample

    def path(self, index: int, seed: int, grid: Grid, cameras: Cameras) -> Path:
        """The file of a case."""
        seed = self.scene.seed_of(index, seed)
        case = [VERSION, self.made_of, index, seed, of_grid(grid), of_rig(cameras)]
        return self.folder / f"{hashlib.sha256(json.dumps(case).encode()).hexdigest()}.h5"


def _write(path: Path, sample: Sample) -> None:
    with written_whole(path) as part, h5py.File(part, "w") as file:
        tensors = {"views": sample.views, "volume": sample.volume, "inside": sample.inside}
        for name, tensor in {**tensors, **sample.maps}.items():
            values = tensor.cpu().numpy()
            file.create_dataset(name, data=values, fletcher32=True, chunks=(1, *values.shape[1:]))
        file.attrs["name"] = sample.name


def _read(path: Path, grid: Grid, cameras: Cameras) -> Sample:
    """The case in a file.

    Raises:
        Refused: it is damaged, or has another size or type than this case.
    """
    volume = (1, *grid.shape)
    expected = {
        "views": ((1, len(cameras), *cameras.shape), "float32"),
        "volume": (volume, "float32"),
        "inside": (volume, "bool"),
    }
    values = {}
    with blaming(path, "is not a case that can be read"), reading(path) as file:
        maps = {name: (volume, "float32") for name in file if name not in expected}
        for name, kind in {**expected, **maps}.items():
            dataset = dataset_in(path, file, name, "a case")
            if (dataset.shape, str(dataset.dtype)) != kind:
                raise Refused(
                    f"{path}: expected {name} as {kind}, got {dataset.shape}, {dataset.dtype}"
                )
            values[name] = torch.from_numpy(dataset[()])
        held = {str(name): values.pop(name) for name in maps}
        return Sample(**values, name=str(file.attrs["name"]), maps=held)


@dataclass(frozen=True)
class Loading:
    """How cases are made and put into batches.

    Args:
        batch_size: cases in a batch.
        workers: processes that make the cases before training, and load batches.
        cache: folder in which cases are kept from run to run, without their noise; None: they are
            made anew by every run. All cases of a run are kept in memory either way.
        rigs: rigs that measure the training cases, of a camera with a `seed`, those of the seeds
            that follow its own; 0: its own rig, as validation and test have.

    Raises:
        ValueError: a number that is too small.
    """

    batch_size: PositiveInt = 1
    workers: NonNegativeInt = 0
    cache: str | None = None
    rigs: NonNegativeInt = 0

    def __post_init__(self) -> None:
        if self.batch_size < 1 or min(self.workers, self.rigs) < 0:
            raise ValueError(
                f"Expected a batch_size of at least 1 and workers and rigs of at least 0, got "
                f"{self.batch_size}, {self.workers} and {self.rigs}"
            )

    @classmethod
    def of(cls, options: Mapping[str, Any]) -> "Loading":
        """The options of a mapping.

        Raises:
            TypeError: an unknown option; the message gives the nearest and all.
        """
        check_options("data", options, (field.name for field in fields(cls)))
        return cls(**options)


#: Series of random cases. Every run is judged on the same ones; its own seed makes the cases that
#: it trains on.
TEST, VAL, TRAIN = 0, 1, 2
#: Which parts of the data each stage of Lightning needs.
STAGES = {"fit": ("train", "val"), "validate": ("val",), "test": ("test",), "predict": ("test",)}


class SceneData(L.LightningDataModule):
    """The data of a run, from plain dicts of names and numbers.

    Random scenes draw training, validation and test cases from different series. A scene from a
    file validates on its last `val` cases and trains on those before; the test cases are the test
    scene's, or the first fifth where that is the same file. So no case is in two sets, unless
    `overlap` asks for it.

    Args:
        scenes: name and options of the scenes "train" and "test".
        measurement: `grid`, options of `Grid.centred`, in the order (x, y, z); `camera`, name and
            options of the rig; `projector`, name and options of what makes the views, None: line
            integrals; `acquisition`, options of `Acquisition`, None: a perfect detector.
        sizes: the number of cases for "train", "val" and "test"; a file may hold fewer.
        overlap: training, validation and test take the first cases of a file, the same ones: for a
            file with one volume.
        seed: of the training cases and their order.
        loading: of `Loading`: cases in a batch, processes, where cases are kept, and by how many
            rigs they are measured.

    Raises:
        TypeError: an unknown option of the acquisition or of loading.
        ValueError: sizes that leave nothing to train on, scenes of different data range, a number
            that is too small.
    """

    def __init__(
        self,
        scenes: Mapping[str, Mapping[str, Any]],
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
        self.sizes, self.loading = dict(sizes), Loading.of(loading)
        self.overlap, self.seed = overlap, seed
        self.rigs = training_rigs(measurement["camera"], self.loading.rigs)
        self._settings = {key: dict(scenes[key]) for key in ("train", "test")}
        self.scenes: dict[str, Scene] = {
            key: SCENES.from_config(scenes[key]) for key in ("train", "test")
        }
        ranges = {key: scene.data_range for key, scene in self.scenes.items()}
        if ranges["train"] != ranges["test"]:
            raise ValueError(
                f"The training and the test scene must share their data_range, got {ranges}"
            )
        self.shared = same_cases(scenes["train"], scenes["test"])
        self._files = {key: list(sha256.files_in(scenes[key])) for key in ("train", "test")}
        self._digests: dict[str, str] = {}
        self.sets: dict[str, SceneDataset | ManyRigs] = {}
        self._order: EpochOrder | None = None
        self._volumes: list[str] | None = None

    @property
    def data_range(self) -> float:
        """The fixed range of values that PSNR and SSIM refer to."""
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
        # a fifth whatever `test` is, since a checkpoint may be older than this `test`
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
        """Compute the cases of a stage unless they exist already."""
        series = {"train": TRAIN + self.seed, "val": VAL, "test": TEST}
        for part in STAGES[stage] if stage else ("train", "val", "test"):
            if part not in self.sets:
                made = self._cases(part, series[part])
                made.prepare(f"{part} cases", self.loading.workers)
                self.sets[part] = made
        if (cases := self.sets.get("train")) is not None:
            if isinstance(cases, ManyRigs):
                self._order = RigOrder(cases, self.seed, *self._share)
            else:
                self._order = EpochOrder(len(cases), self.seed, *self._share)

    @property
    def _share(self) -> tuple[int, int]:
        """This process's number in training, and the number of all."""
        return (self.trainer.global_rank, self.trainer.world_size) if self.trainer else (0, 1)

    def _cases(self, part: str, series: int) -> SceneDataset | ManyRigs:
        """The cases of "train", "val" or "test"."""
        measured = self._measured("test" if part == "test" else "train")
        indices = self.indices(part)
        if part == "train" and self.rigs:
            together = self.loading.batch_size * self._share[1]
            return ManyRigs(measured, self.grid, self.rigs, indices, series, together)
        return SceneDataset(measured, self.grid, self.cameras, indices, series)

    def _measured(self, key: str) -> Acquired:
        """The scene "train" or "test" behind its detector, with the cases that are kept of it."""
        scene, store = self.scenes[key], None
        if self.loading.cache is not None:
            digests = self.digests(key)
            made_of = {
                "version": __version__,
                "scene": self._settings[key],
                "files": {path: digests[path] for path in self._files[key]},
                "projector": self.projector,
                "fine": self.acquisition.fine,
            }
            store = CaseStore(self.loading.cache, made_of, scene)
        return Acquired(scene, self.projector, self.acquisition, store)

    def train_dataloader(self) -> DataLoader[dict[str, Any]]:
        """Training batches, in another random order in every epoch."""
        return self._loader("train", self._order)

    def val_dataloader(self) -> DataLoader[dict[str, Any]]:
        """Validation batches; with several processes, this one's share, see `shared`."""
        return self._loader("val", shared(len(self.sets["val"]), *self._share))

    def test_dataloader(self) -> DataLoader[dict[str, Any]]:
        """Test batches."""
        return self._loader("test")

    predict_dataloader = test_dataloader

    def transfer_batch_to_device(
        self, batch: Any, device: torch.device, dataloader_idx: int
    ) -> Any:
        """A batch on the device; the number of its rig, which the host asks for, stays."""
        moved = super().transfer_batch_to_device(batch, device, dataloader_idx)
        return {**moved, "rig": batch["rig"]} if "rig" in batch else moved

    def _loader(
        self, part: str, order: EpochOrder | range | None = None
    ) -> DataLoader[dict[str, Any]]:
        return DataLoader(
            self.sets[part],
            self.loading.batch_size,
            sampler=order,
            num_workers=self.loading.workers,
            persistent_workers=self.loading.workers > 0,
            pin_memory=torch.cuda.is_available(),
            generator=order.generator
            if isinstance(order, EpochOrder)
            else torch.Generator(),  # or each epoch draws from the global one
        )

    def digests(self, *parts: str, rig: bool = True) -> dict[str, str]:
        """SHA-256 of the rig, unless it may be another, and of every file by its path that the
        scenes of `parts` ("train", "test") read.

        Each is read once.
        """
        paths = sorted({path for part in parts for path in self._files[part]})
        self._digests |= {path: sha256.of_file(path) for path in paths if path not in self._digests}
        own = {sha256.RIG: sha256.of_rig(self.cameras)} if rig else {}
        return own | {path: self._digests[path] for path in paths}

    def state_dict(self) -> dict[str, Any]:
        """State for a checkpoint: epoch and position in it, names of the training cases, digests of
        their volumes, of the rig and of the files.
        """
        loop = self.trainer.fit_loop if self.trainer else None
        if loop is None or self._order is None:
            return {}
        n_batches = int(loop.epoch_loop.batch_progress.current.processed)  # pyright: ignore[reportAttributeAccessIssue]
        n_done = n_batches * self.loading.batch_size * self._order.world
        whole = n_done >= self._order.count  # the epoch: then the next one goes on
        place = {"epoch": self._order.epoch + whole, "seen": 0 if whole else n_done}
        cases = self.sets["train"].prepare()
        if self._volumes is None:
            self._volumes = [sha256.of_volume(volume) for volume in cases.get("volume", ())]
        return {
            **place,
            "cases": list(cases["name"]),
            "volumes": self._volumes,
            "digests": self.digests("train"),
        }

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Resume from a checkpoint with the cases that the interrupted epoch has not used.

        Raises:
            Refused: the rig or a file is not what the checkpoint was trained with.
        """
        if self._order is not None and state_dict:
            sha256.compare(self.digests("train"), state_dict.get("digests", {}), "the checkpoint")
            self._order.resume(state_dict["epoch"], state_dict["seen"])
            # Lightning looks for this at the loader and does not find it there.
            warnings.filterwarnings(
                "ignore", ".*ended before the epoch ended and your dataloader is not resumable"
            )


def _turns(scene: Scene, size: int, cases: range, vary: bool) -> list[int]:
    """The first `size` cases of a range; with `vary`, a scene that varies them counts on with
    copies of the range.
    """
    n = len(cases)
    count = size if vary and scene.vary else min(size, n)
    return [i // n * (scene.length or 0) + cases[i % n] for i in range(count)]


def same_cases(first: Mapping[str, Any], second: Mapping[str, Any]) -> bool:
    """Whether two scenes have the same cases: they are equal, or read one file."""
    paths = [Path(scene["path"]).resolve() for scene in (first, second) if "path" in scene]
    return dict(first) == dict(second) or (len(paths) == 2 and paths[0] == paths[1])
