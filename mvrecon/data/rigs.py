"""Training cases of many rigs: each rig measures some of them, and a batch is of one rig."""

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor
from torch.utils.data import Dataset

from mvrecon.core.parts import CAMERAS
from mvrecon.data.dataset import EpochOrder, SceneDataset
from mvrecon.data.scenes.sample import Scene
from mvrecon.geometry.cameras.camera import Cameras
from mvrecon.geometry.grid import Grid


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
    ):
        self.together = together
        self.per_rig = len(indices) // len(rigs) // together * together
        if not self.per_rig:
            raise ValueError(
                f"Expected a batch of {together} cases for each of {len(rigs)} rigs, got "
                f"{len(indices)} cases"
            )
        self.parts = [
            SceneDataset(scene, grid, cameras, indices[i :: len(rigs)][: self.per_rig], seed)
            for i, cameras in enumerate(rigs)
        ]

    def __len__(self) -> int:
        return self.per_rig * len(self.parts)

    def __getitem__(self, item: int) -> dict[str, Any]:
        if not 0 <= item < len(self):
            raise IndexError(f"A dataset of {len(self)} cases has no item {item}")
        rig, case = divmod(item, self.per_rig)
        return {**self.parts[rig][case], "rig": rig + 1}

    def prepare(self, what: str = "cases", workers: int = 0) -> dict[str, Any]:
        """Compute every case once; see `SceneDataset.prepare`. Returns all names and volumes."""
        made = [
            part.prepare(f"{what} of rig {rig} of {len(self.parts)}", workers)
            for rig, part in enumerate(self.parts, start=1)
        ]
        return {key: [value for one in made for value in one[key]] for key in ("name", "volume")}


class RigOrder(EpochOrder):
    """A random order in which as many items as the batches of all processes have follow one another
    of one rig.

    Args:
        cases: of the rigs; the batches of all processes together hold `cases.together` of one.
        seed: of the orders.
        rank: number of this process.
        world: number of processes.
    """

    def __init__(self, cases: ManyRigs, seed: int, rank: int = 0, world: int = 1):
        self.rigs, self.together = len(cases.parts), cases.together
        super().__init__(len(cases), seed, rank, world)

    def order(self, rng: torch.Generator) -> Tensor:
        """The items of one epoch."""
        per_rig = self.count // self.rigs
        own = [rig * per_rig + torch.randperm(per_rig, generator=rng) for rig in range(self.rigs)]
        batches = torch.cat(own).reshape(-1, self.together)
        return batches[torch.randperm(len(batches), generator=rng)].flatten()
