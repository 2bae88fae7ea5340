"""Training cases of many rigs: each rig measures some of them, and a batch is of one rig."""

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor
from torch.utils.data import Dataset

from mvrecon.cameras.camera import Cameras
from mvrecon.data.dataset import EpochOrder, SceneDataset
from mvrecon.geometry.grid import Grid
from mvrecon.parts import CAMERAS
from mvrecon.scenes.sample import Scene


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
        batch_size: divides the number of cases of a rig.

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
        batch_size: int = 1,
    ):
        self.each = len(indices) // len(rigs) // batch_size * batch_size
        if not self.each:
            raise ValueError(
                f"Expected a batch of {batch_size} cases for each of {len(rigs)} rigs, got "
                f"{len(indices)} cases"
            )
        self.parts = [
            SceneDataset(scene, grid, cameras, indices[i :: len(rigs)][: self.each], seed)
            for i, cameras in enumerate(rigs)
        ]

    def __len__(self) -> int:
        return self.each * len(self.parts)

    def __getitem__(self, item: int) -> dict[str, Any]:
        if not 0 <= item < len(self):
            raise IndexError(f"A dataset of {len(self)} cases has no item {item}")
        rig, case = divmod(item, self.each)
        return {**self.parts[rig][case], "rig": rig + 1}

    def prepare(self, what: str = "cases", workers: int = 0) -> dict[str, Any]:
        """Compute every case once; see `SceneDataset.prepare`. Returns all names and volumes."""
        made = [
            part.prepare(f"{what} of rig {rig} of {len(self.parts)}", workers)
            for rig, part in enumerate(self.parts, start=1)
        ]
        return {key: [value for one in made for value in one[key]] for key in ("name", "volume")}


class RigOrder(EpochOrder):
    """A random order in which as many items as a batch has follow one another of one rig.

    Args:
        rigs: that have the same number of items, one rig behind the other.
        each: items of a rig.
        batch_size: divides `each`.
        seed: of the orders.
    """

    def __init__(self, rigs: int, each: int, batch_size: int, seed: int):
        self.rigs, self.batch_size = rigs, batch_size
        super().__init__(rigs * each, seed)

    def order(self, rng: torch.Generator) -> Tensor:
        """The items of one epoch."""
        each = self.count // self.rigs
        own = [rig * each + torch.randperm(each, generator=rng) for rig in range(self.rigs)]
        batches = torch.cat(own).reshape(-1, self.batch_size)
        return batches[torch.randperm(len(batches), generator=rng)].flatten()
