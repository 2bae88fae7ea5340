"""Scenes of analytic phantoms: exact views, supersampled true volumes, and random numbers that
depend on the case only.
"""

import math
from abc import abstractmethod
from dataclasses import dataclass
from typing import Any, ClassVar

import torch
from jaxtyping import Float
from torch import Tensor

from mvrecon.core.numbers import generator
from mvrecon.core.quantities import PositiveFloat
from mvrecon.data.scenes.sample import Rays, Sample, Scene
from mvrecon.data.scenes.solids import Phantom, values_and_touched, voxelise
from mvrecon.geometry.grid import Grid


@dataclass(frozen=True, kw_only=True)
class AnalyticScene(Scene):
    """Cases of one kind of phantom.

    Args:
        field: radius of the sphere about the grid's centre that contains the object, as a fraction
            of the grid's shortest edge.
        value: the greatest value; the least is 0.
        unit: unit of the value.

    Raises:
        ValueError: a field outside (0, 0.5], or a value that is not positive.
    """

    field: PositiveFloat = 0.42
    value: PositiveFloat = 1.0
    unit: str = "1/mm"

    kind: ClassVar[str]
    length: ClassVar[int | None] = None

    def __post_init__(self) -> None:
        if not 0 < self.field <= 0.5:
            raise ValueError(
                f"The field must be a fraction in (0, 0.5] of the grid's shortest edge, got "
                f"{self.field}"
            )
        if not 0 < self.value < math.inf:
            raise ValueError(
                f"The greatest value of a scene must be finite and positive, got {self.value}"
            )

    @property
    def data_range(self) -> float:
        """The fixed range of values for PSNR and SSIM."""
        return self.value

    @abstractmethod
    def phantom(self, rng: torch.Generator, grid: Grid) -> Phantom:
        """A phantom in the field of `grid`."""

    def radius(self, grid: Grid) -> float:
        """Radius of the field in mm."""
        return self.field * min(
            n * step for n, step in zip(grid.shape[::-1], grid.spacing, strict=True)
        )

    def sample(self, index: int, seed: int, grid: Grid, cameras: Rays) -> Sample:
        """Return the case `index` of the series `seed`, seen by `cameras`, with its true volume.

        Raises:
            IndexError: the scene has no such case.
        """
        phantom = self._phantom_of(index, seed, grid)
        return render(phantom, grid, cameras, f"{self.kind}-{seed}-{index}")

    def _phantom_of(self, index: int, seed: int, grid: Grid) -> Phantom:
        if self.length is not None and not index < self.length:
            raise IndexError(
                f"The scene {self.kind!r} has {self.length} case(s), got index {index}"
            )
        return self.phantom(generator(seed, index), grid)

    def finer(
        self, index: int, seed: int, grid: Grid, cameras: Any, factor: int
    ) -> Float[Tensor, "1 d h w"]:
        """The case's values on `grid.refined(factor)`, the mean over at least 2^3 points of each
        voxel.
        """
        phantom = self.phantom(generator(seed, index), grid)
        return voxelise(phantom, grid.refined(factor), max(2, -(-4 // factor)))[None]

    def pooled(
        self, index: int, seed: int, grid: Grid, cameras: Any, fine: Float[Tensor, "1 d h w"]
    ) -> Sample:
        """Return the case without views [1 0 0 0], its true volume averaged from that of `finer`.

        Raises:
            IndexError: the scene has no such case.
        """
        phantom = self._phantom_of(index, seed, grid)
        factor = fine.shape[-1] // grid.shape[-1]
        volume = torch.nn.functional.avg_pool3d(fine[None], factor)[0]
        inside = volume[0] > 0
        if any((part.values < 0).any() for part in phantom.parts):  # values may cancel
            inside |= values_and_touched(phantom, grid, max(4, 2 * factor))[1]
        name = f"{self.kind}-{seed}-{index}"
        return Sample(volume.new_zeros(1, 0, 0, 0), volume, inside[None], name)


def render(phantom: Phantom, grid: Grid, cameras: Rays, name: str, factor: int = 4) -> Sample:
    """Return exact views of a phantom, and the mean over factor^3 points of each voxel."""
    start, end = cameras.rays()
    views = phantom.integrals(start.detach().cpu(), end.detach().cpu(), cameras.ray_extent)
    volume, inside = values_and_touched(phantom, grid, factor)
    return Sample(views[None].to(torch.float32), volume[None], inside[None], name)
