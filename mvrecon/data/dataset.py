"""Training samples from the cases of a scene, seen by one rig or by many, their random order in
each epoch, and a folder that keeps the cases as a perfect detector measures them from run to run.
"""

import hashlib
import json
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import h5py
import torch
from rich.console import Console
from rich.progress import track
from torch.utils.data import DataLoader, Dataset, Sampler

from mvrecon.core.files.atomic import written_whole
from mvrecon.core.files.checks import Refused
from mvrecon.core.machine import rank
from mvrecon.core.numbers import case_numbers, generator, mixed
from mvrecon.core.parts import CAMERAS
from mvrecon.data.digests import of_grid, of_rig
from mvrecon.data.scenes.sample import Sample, Scene
from mvrecon.data.storage import dataset_in, opened
from mvrecon.geometry.cameras.camera import Cameras
from mvrecon.geometry.grid import Grid
from mvrecon.operators.visual_hull.support import warn_of_gaps

#: Raised where what a scene, a projector or a file of this store is has changed: older files are
#: not read.
VERSION = 2


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
        with written_whole(path) as part, h5py.File(part, "w") as file:
            tensors = {"views": sample.views, "volume": sample.volume, "inside": sample.inside}
            for name, tensor in {**tensors, **sample.maps}.items():
                values, chunks = tensor.cpu().numpy(), (1, *tensor.shape[1:])
                file.create_dataset(name, data=values, fletcher32=True, chunks=chunks)
            file.attrs["name"] = sample.name
        return sample

    def path(self, index: int, seed: int, grid: Grid, cameras: Cameras) -> Path:
        """The file of a case."""
        seed = self.scene.seed_of(index, seed)
        case = [VERSION, self.made_of, index, seed, of_grid(grid), of_rig(cameras)]
        return self.folder / f"{hashlib.sha256(json.dumps(case).encode()).hexdigest()}.h5"


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


TENSORS = ("views", "volume", "inside")


class SceneDataset(Dataset[dict[str, Any]]):
    """Cases of one scene; each item is a pure function of its index, whichever process asks for it.
    Fresh cases are others in every epoch: item `i + epoch * len(cases)` is case i of that epoch.

    An item has "views" [1 m v u], "volume" and "inside" [1 d h w], and "name"; where the rig is
    disturbed also its errors by name: "shift_px" [m 2], "gain" [m], "wrong" [m] and others; and the
    maps [1 d h w] of its sample by their names.

    Args:
        scene: where the cases come from.
        grid: of the truth.
        cameras: that see it.
        indices: of the cases.
        seed: the series of cases.
        cache: keep every case in memory once it was made; `prepare` makes them all.
        fresh: by how much the index of a case grows from one epoch to the next; 0: the same cases
            in every epoch.

    Warns:
        UserWarning: rays are further apart than the scene's wells are wide.

    Raises:
        ValueError: a case whose views or volume are not finite.
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
        self._ready: dict[str, Any] | None = None
        if (width := scene.thinnest(grid)) < math.inf:
            warn_of_gaps(width, "wells", cameras, grid)

    def __len__(self) -> int:
        return len(self.indices)

    def __getitem__(self, item: int) -> dict[str, Any]:
        if item < 0 or (item >= len(self) and not self.fresh):
            raise IndexError(f"A dataset of {len(self)} cases has no item {item}")
        if self.cache:
            return {key: values[item] for key, values in self.prepare().items()}
        return self.made(item)

    def prepare(self, what: str = "cases", workers: int = 0) -> dict[str, Any]:
        """Compute every case once, in so many processes beside this one, in a few blocks of memory
        which worker processes share. Of fresh cases only those of a file as they lie there, which
        says what a network was trained on.
        """
        if self._ready is None:
            console = Console(stderr=True)
            cases = range(len(self))
            if self.fresh:
                own = self.scene.length or 0
                cases = [item for item in cases if self.indices[item] < own]
            made = DataLoader(cases, batch_size=None, collate_fn=self.made, num_workers=workers)  # type: ignore[arg-type]
            quiet = rank() > 0
            names: list[str] = []
            blocks: dict[str, Any] = {}
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
                    # small tensors of single cases would keep the heap from shrinking
                    block = blocks.setdefault(key, value.new_empty(len(cases), *value.shape))
                    block[len(names) - 1] = value
            self._ready = blocks | {"name": names}
        return self._ready

    def made(self, item: int) -> dict[str, Any]:
        """The case, made anew."""
        epoch, case = divmod(item, len(self))
        index = self.indices[case] + epoch * self.fresh
        with case_numbers(self.seed, index):
            sample: Sample = self.scene.sample(index, self.seed, self.grid, self.cameras)
        made = {key: getattr(sample, key) for key in TENSORS}
        for key in ("views", "volume"):
            if bad := int((~made[key].isfinite()).sum()):
                raise ValueError(
                    f"{sample.name}: expected finite {key}, got {bad} values that are not"
                )
        return {**made, **sample.maps, **sample.errors, "name": sample.name}


def shared(count: int, rank: int, world: int) -> range:
    """The items of one of several processes, none of which another one has.

    Raises:
        ValueError: fewer items than processes, but for none at all.
    """
    if 0 < count < world:
        raise ValueError(
            f"Expected no validation case or at least one for each of {world} processes "
            f"(data.sizes.val), got {count}"
        )
    return range(rank, count, world)


class EpochOrder(Sampler[int]):
    """A random order of `count` items that depends only on (seed, epoch), so that a resumed run
    continues with the items it has not used.

    Several processes go through one order together, each with every `world`-th item of it; where
    these do not come out even, the order ends with its beginning.

    Args:
        count: of items.
        seed: of the orders.
        rank: number of this process.
        world: number of processes.
        rigs: number of rigs that have the same number of items each, in their order, and how many
            items of one rig follow one another, those of a batch of all processes; None: one rig.
        fresh: whether each epoch has items of its own, those from `epoch * count` on.

    Attributes:
        generator: for the loader, which seeds its worker processes from it; (seed, epoch) alone
            decide that, too.

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

        Worker processes ask for their first items before Lightning tells the epoch.
        """
        self.resumed = (epoch, n_done)
        self.set_epoch(epoch)


def single_cases(batch: Mapping[str, Any]) -> list[dict[str, Any]]:
    """The cases of a batch, each as a batch of one."""
    count = len(batch["views"])
    return [{key: value[i : i + 1] for key, value in batch.items()} for i in range(count)]


def camera_of(camera: Mapping[str, Any], rig: int) -> dict[str, Any]:
    """Name and options of a training rig: the run's camera with its `seed` moved on by `rig`; 0 is
    the run's own.
    """
    return {**camera, "seed": camera.get("seed", 0) + rig} if rig else dict(camera)


def training_rigs(camera: Mapping[str, Any], count: int) -> list[Cameras]:
    """The rigs that a network is trained on, in mm; the run's own is none of them.

    Raises:
        ValueError: a camera that is not drawn at random, by a `seed`.
    """
    if count and camera["name"] != "random" and "seed" not in camera:
        raise ValueError(
            f"Expected a camera with a seed for data.rigs={count}, such as camera=random, got "
            f"{camera['name']!r}"
        )
    return [CAMERAS.from_config(camera_of(camera, rig)) for rig in range(1, count + 1)]


class ManyRigs(Dataset[dict[str, Any]]):
    """Cases of one scene, the same number of them seen by each of several rigs, in the order of the
    rigs; `rig` of an item counts from 1.

    Args:
        scene: where the cases come from.
        grid: of the truth.
        rigs: that see them.
        indices: of the cases; the rigs take them in turn, and those left over are left out.
        seed: the series of cases.
        together: cases of one rig in the batches of all processes, divides their number.
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

    def __getitem__(self, item: int) -> dict[str, Any]:
        if item < 0 or (item >= len(self) and not self.fresh):
            raise IndexError(f"A dataset of {len(self)} cases has no item {item}")
        epoch, item = divmod(item, len(self))
        rig, case = divmod(item, self.per_rig)
        return {**self.parts[rig][epoch * self.per_rig + case], "rig": rig + 1}

    def prepare(self, what: str = "cases", workers: int = 0) -> dict[str, Any]:
        """Compute every case once; see `SceneDataset.prepare`. Returns all names and volumes."""
        made = [
            part.prepare(f"{what} of rig {rig} of {len(self.parts)}", workers)
            for rig, part in enumerate(self.parts, start=1)
        ]
        keys = "name", "volume"
        return {key: [value for one in made for value in one.get(key, ())] for key in keys}
