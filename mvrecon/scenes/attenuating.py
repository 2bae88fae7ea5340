"""Scenes whose cases have matter that attenuates what they emit."""

from abc import abstractmethod
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from mvrecon.geometry.grid import Grid
from mvrecon.scenes.analytic import AnalyticScene, generator
from mvrecon.scenes.sample import Rays, Sample
from mvrecon.scenes.solids import Phantom
from mvrecon.scenes.voxelise import voxelise


@dataclass(frozen=True, kw_only=True)
class AttenuatingScene(AnalyticScene):
    """Cases of phantoms that emit, each with the matter about it; see `AnalyticScene`."""

    @abstractmethod
    def matter(self, rng: torch.Generator, grid: Grid) -> Phantom:
        """Linear attenuation in 1/mm of the case whose `phantom` is drawn from the same numbers."""

    def sample(self, index: int, seed: int, grid: Grid, cameras: Rays) -> Sample:
        """The case `index` of the series `seed`, its line integrals without attenuation, its truth
        and its attenuation on `grid`.

        Raises:
            IndexError: the scene has no such case.
        """
        sample = super().sample(index, seed, grid, cameras)
        return replace(sample, mu=self.attenuation(index, seed, grid))

    def attenuation(
        self, index: int, seed: int, grid: Grid, factor: int = 1
    ) -> Float[Tensor, "1 d h w"]:
        """Linear attenuation of a case in 1/mm on `grid.refined(factor)`, the mean over at least
        2^3 points of each voxel.
        """
        matter = self.matter(generator(seed, index), grid)
        fine = grid.refined(factor) if factor > 1 else grid
        return voxelise(matter, fine, max(2, -(-4 // factor))).clamp_min(0)[None]
