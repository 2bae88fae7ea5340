"""Training samples from the cases of a scene, seen by one or many rigs, their random order in each
epoch, and a cache folder of noiseless cases.
"""

import hashlib
import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NotRequired

import torch
from jaxtyping import Bool, Float
from rich.console import Console
from rich.progress import track
from torch import Tensor
from torch.utils.data import DataLoader, Dataset, Sampler
from typing_extensions import TypedDict

from mvrecon.core.files.checks import Refused
from mvrecon.core.machine import rank
from mvrecon.core.numbers import case_numbers, generator, mixed
from mvrecon.core.parts import CAMERAS, CameraPart
from mvrecon.data.digests import of_grid, of_rig
from mvrecon.data.scenes.sample import Sample, Scene
from mvrecon.data.storage import dataset_in, opened, written
from mvrecon.geometry.cameras.camera import Cameras
from mvrecon.geometry.grid import Grid

#: Raised when the output of a scene or projector, or the format of this cache, changes: older files
#: are ignored.
CACHE_VERSION = 2


class CaseStore:
    """A cache folder of cases as a perfect detector measures them, one file each.

    A file is named by a SHA-256 digest of everything its case depends on: `made_of`, index, seed,
    grid, rig and the amplitudes of a breathing object, but not detector effects and drifted gains.
    Files are written atomically, so several runs may share a folder; a damaged file is recomputed.

    Args:
        folder: created when the first case is written.
        made_of: settings of scene and projector and digests of their files and code: names,
            numbers, paths.
        scene: its `seed_of(index, seed)` gives the seed on which a case depends.
    """

    def __init__(self, folder: str | Path, made_of: Mapping[str, Any], scene: Scene):
        self.folder, self.made_of = Path(folder), json.dumps(made_of, sort_keys=True, default=str)
        self.scene = scene

    def __call__(
        self,
        index: int,
        seed: int,
        grid: Grid,
        cameras: Any,
        amplitudes_mm: Sequence[float],
        make: Callable[[], Sample],
    ) -> Sample:
        """Return the cached case, or else call `make` and cache its case.

        Explicit rays have no digest: their cases are not cached.

        Raises:
            OSError: the folder cannot be written.
        """
        if not isinstance(cameras, Cameras):
            return make()
        path = self.path(index, seed, grid, cameras, amplitudes_mm)
        if path.exists():
            try:
                return _read(path, grid, cameras)
            except Refused:  # cut short or damaged: recompute
                pass
        sample = make()
        with written(path) as file:
            tensors = {"views": sample.views, "volume": sample.volume, "inside": sample.inside}
            for name, tensor in {**tensors, **sample.maps}.items():
                values, chunks = tensor.cpu().numpy(), (1, *tensor.shape[1:])
                file.create_dataset(name, data=values, fletcher32=True, chunks=chunks)
            file.attrs["name"] = sample.name
        return sample

    def path(
        self,
        index: int,
        seed: int,
        grid: Grid,
        cameras: Cameras,
        amplitudes_mm: Sequence[float] = (),
    ) -> Path:
        """The file of a case."""
        seed = self.scene.seed_of(index, seed)
        case = [CACHE_VERSION, self.made_of, index, seed, of_grid(grid), of_rig(cameras)]
        case += [list(amplitudes_mm)] if any(amplitudes_mm) else []
        return self.folder / f"{hashlib.sha256(json.dumps(case).encode()).hexdigest()}.h5"


def _read(path: Path, grid: Grid, cameras: Cameras) -> Sample:
    """The case in a file.

    Raises:
        Refused: it is damaged, or of another size or type than this case.
    """
    volume = (1, *grid.shape)
    expected = {
        "views": ((1, len(cameras), *cameras.shape), "float32"),
        "volume": (volume, "float32"),
        "inside": (volume, "bool"),
    }
    values = {}
    with opened(path, "a case", "is not a case that can be read") as file:
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


class Case(TypedDict, extra_items=Tensor):
    """One case; beside what all have, the maps [1 d h w] of its sample by name, and of a disturbed
    rig the errors: "shift_px" [m 2], "gain" [m], "wrong" [m] and others.

    Attributes:
        views: the views as measured.
        volume: the truth.
        inside: the voxels of the object.
        name: name of the case.
        rig: number of its rig, see `ManyRigs`.
    """

    views: Float[Tensor, "1 m v u"]
    volume: Float[Tensor, "1 d h w"]
    inside: Bool[Tensor, "1 d h w"]
    name: str
    rig: NotRequired[int]


class Batch(TypedDict, total=False, extra_items=Tensor):
    """Several cases, stacked; see `Case`."""

    views: Float[Tensor, "b 1 m v u"]
    volume: Float[Tensor, "b 1 d h w"]
    inside: Bool[Tensor, "b 1 d h w"]
    name: list[str]


class SceneDataset(Dataset[Case]):
    """Cases of one scene; each item is a pure function of its index in any process. Fresh cases
    differ in every epoch: item `i + epoch * len(cases)` is case i of that epoch.

    Args:
        scene: the source of the cases.
        grid: grid of the true volume.
        cameras: the rig.
        indices: indices of the cases.
        seed: the series of cases.
        cache: keep cases in memory once computed; `prepare` computes them all.
        fresh: increment of a case's index from epoch to epoch; 0: the same cases in every epoch.

    Raises:
        ValueError: non-finite views or volumes.
    """

    def __init__(
        self,
        scene: Scene,
        grid: Grid,
        cameras: Cameras,
        indices: Sequence[int],
        seed: int,
        cache: bool = True,
        fresh: int = 0,
    ):
        self.scene, self.grid, self.cameras = scene, grid, cameras
        self.indices, self.seed, self.fresh = tuple(indices), seed, fresh
        self.cache = cache and not fresh
        self._ready: Batch | None = None

    def __len__(self) -> int:
        return len(self.indices)

    def __getitem__(self, item: int) -> Case:
        if item < 0 or (item >= len(self) and not self.fresh):
            raise IndexError(f"A dataset of {len(self)} cases has no item {item}")
        if self.cache:
            case: Any = {key: values[item] for key, values in self.prepare().items()}
            return case
        return self.made(item)

    def prepare(self, what: str = "cases", workers: int = 0) -> Batch:
        """Compute every case once, in `workers` processes beside this one, into a few blocks of
        shared memory. Of fresh cases only those of a file are computed, unvaried, to identify the
        training data.
        """
        ready = self._ready
        if ready is None:
            console = Console(stderr=True)
            cases = range(len(self))
            if self.fresh:
                own = self.scene.length or 0
                cases = [item for item in cases if self.indices[item] < own]
            made = DataLoader(cases, batch_size=None, collate_fn=self.made, num_workers=workers)  # type: ignore[arg-type]
            quiet = rank() > 0
            names: list[str] = []
            blocks: Any = {}
            for item in track(
                made,
                f"Preparing {what}",
                len(cases),
                transient=True,
                console=console,
                disable=quiet,
            ):
                names.append(item.pop("name"))
                for key, value in item.items():
                    # small tensors of single cases would fragment the heap
                    block = blocks.setdefault(key, value.new_empty(len(cases), *value.shape))
                    block[len(names) - 1] = value
            self._ready = ready = blocks | {"name": names}
        return ready

    def made(self, item: int) -> Case:
        """Compute a case."""
        sample = self.sample(item)
        own = {key: getattr(sample, key) for key in ("views", "volume", "inside", "name")}
        case: Any = {**own, **sample.maps, **sample.errors}
        return case

    def sample(self, item: int) -> Sample:
        """Compute the sample of a case.

        Raises:
            ValueError: non-finite views or volumes.
        """
        epoch, case = divmod(item, len(self))
        index = self.indices[case] + epoch * self.fresh
        with case_numbers(self.seed, index):
            sample = self.scene.sample(index, self.seed, self.grid, self.cameras)
        for key in ("views", "volume"):
            if bad := int((~getattr(sample, key).isfinite()).sum()):
                raise ValueError(
                    f"{sample.name}: expected finite {key}, got {bad} values that are not"
                )
        return sample


def shared(count: int, rank: int, world: int) -> range:
    """Return this process's share of the items, disjoint from the others'.

    Raises:
        ValueError: more than zero but fewer items than processes.
    """
    if 0 < count < world:
        raise ValueError(
            f"Expected no validation case or at least one for each of {world} processes "
            f"(data.sizes.val), got {count}"
        )
    return range(rank, count, world)


class EpochOrder(Sampler[int]):
    """A random order of `count` items that depends on (seed, epoch) only, so that a resumed run
    continues with unused items.

    Each of several processes takes every `world`-th item of a common order, which wraps around to
    equal shares.

    Args:
        count: number of items.
        seed: seed of the orders.
        rank: number of this process.
        world: number of processes.
        rigs: number of rigs, in order and with equally many items each, and number of consecutive
            items of one rig, those of a batch of all processes; None: one rig.
        fresh: whether each epoch has its own items, from `epoch * count` on.

    Attributes:
        generator: seeds the loader's worker processes, also by (seed, epoch) only.

    Raises:
        ValueError: fewer items than processes.
    """

    def __init__(
        self,
        count: int,
        seed: int,
        rank: int = 0,
        world: int = 1,
        rigs: tuple[int, int] | None = None,
        fresh: bool = False,
    ):
        if 0 < count < world:
            raise ValueError(f"Expected a training case for each of {world} processes, got {count}")
        self.count, self.seed, self.rank, self.world = count, seed, rank, world
        self.rigs, self.fresh = rigs, fresh
        self.resumed, self.generator = (0, 0), torch.Generator()
        self.set_epoch(0)

    def __len__(self) -> int:
        return -(-self.count // self.world)

    def __iter__(self) -> Iterator[int]:
        epoch, n_done = self.resumed
        rng = generator(self.seed, self.epoch)
        if self.rigs is None:
            order = torch.randperm(self.count, generator=rng).tolist()
        else:
            n, together = self.rigs
            size = self.count // n
            own = [rig * size + torch.randperm(size, generator=rng) for rig in range(n)]
            batches = torch.cat(own).reshape(-1, together)
            order = batches[torch.randperm(len(batches), generator=rng)].flatten().tolist()
        first = self.epoch * self.count if self.fresh else 0
        order = [first + item for item in order + order[: -self.count % self.world]]
        rest = order[n_done:] if self.epoch == epoch else order
        return iter(rest[self.rank :: self.world])

    def set_epoch(self, epoch: int) -> None:
        """Set the epoch of the next order; Lightning calls this."""
        self.epoch = epoch
        self.generator.manual_seed(mixed(self.seed, epoch))

    def resume(self, epoch: int, n_done: int) -> None:
        """Continue an epoch after its first `n_done` items, which the interrupted run has used.

        Worker processes fetch their first items before Lightning sets the epoch.
        """
        self.resumed = (epoch, n_done)
        self.set_epoch(epoch)


def single_cases(batch: Batch) -> list[Batch]:
    """Split a batch into batches of one case."""
    count = len(batch["views"])
    cases: Any = [{k: value[i : i + 1] for k, value in batch.items()} for i in range(count)]
    return cases


def camera_of(camera: CameraPart, rig: int) -> CameraPart:
    """Name and options of a training rig: the run's camera with `seed + rig`; 0 is the
    run's own.
    """
    return {**camera, "seed": camera.get("seed", 0) + rig} if rig else dict(camera)


def training_rigs(camera: CameraPart, count: int) -> list[Cameras]:
    """Return the training rigs, without the run's own.

    Raises:
        ValueError: a camera without a `seed`.
    """
    if count and camera["name"] != "random" and "seed" not in camera:
        raise ValueError(
            f"Expected a camera with a seed for data.rigs={count}, such as camera=random, got "
            f"{camera['name']!r}"
        )
    return [CAMERAS.from_config(camera_of(camera, rig)) for rig in range(1, count + 1)]


class ManyRigs(Dataset[Case]):
    """Cases of one scene, equally many for each of several rigs, in the order of the rigs; `rig` of
    an item counts from 1.

    Args:
        scene: the source of the cases.
        grid: grid of the true volume.
        rigs: the rigs.
        indices: indices of the cases, dealt to the rigs in turn; the remainder is dropped.
        seed: the series of cases.
        together: consecutive cases of one rig, those of a batch of all processes; divides their
            number.
        fresh: see `SceneDataset`.

    Raises:
        ValueError: fewer cases than a batch for each rig.
    """

    def __init__(
        self,
        scene: Scene,
        grid: Grid,
        rigs: Sequence[Cameras],
        indices: Sequence[int],
        seed: int,
        together: int = 1,
        fresh: int = 0,
    ):
        self.together, self.fresh = together, fresh
        self.per_rig = len(indices) // len(rigs) // together * together
        if not self.per_rig:
            raise ValueError(
                f"Expected a batch of {together} cases for each of {len(rigs)} rigs, got "
                f"{len(indices)} cases"
            )
        self.parts = [
            SceneDataset(
                scene, grid, cameras, indices[i :: len(rigs)][: self.per_rig], seed, fresh=fresh
            )
            for i, cameras in enumerate(rigs)
        ]

    def __len__(self) -> int:
        return self.per_rig * len(self.parts)

    def __getitem__(self, item: int) -> Case:
        if item < 0 or (item >= len(self) and not self.fresh):
            raise IndexError(f"A dataset of {len(self)} cases has no item {item}")
        epoch, item = divmod(item, len(self))
        rig, case = divmod(item, self.per_rig)
        return {**self.parts[rig][epoch * self.per_rig + case], "rig": rig + 1}

    def prepare(self, what: str = "cases", workers: int = 0) -> Batch:
        """Compute every case once; see `SceneDataset.prepare`. Returns all names and volumes."""
        made = [
            part.prepare(f"{what} of rig {rig} of {len(self.parts)}", workers)
            for rig, part in enumerate(self.parts, start=1)
        ]
        keys = "name", "volume"
        whole: Any = {key: [value for one in made for value in one.get(key, ())] for key in keys}
        return whole
