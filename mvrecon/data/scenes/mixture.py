"""A mixture of scenes: their cases in turn."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

from jaxtyping import Float
from torch import Tensor

from mvrecon.core.parts import SCENES
from mvrecon.data.scenes.sample import Mapped, Rays, Sample, Scene, Thin, finer
from mvrecon.geometry.grid import Grid


class Mixture:
    """Cases of several scenes in turn: case i comes from scene i mod n. A scene that ends starts
    again.

    Args:
        scenes: the configuration `{name: ..., **options}` of each scene.

    Raises:
        ValueError: no scenes, or scenes whose data range or unit differ.
    """

    def __init__(self, scenes: Sequence[Mapping[str, Any]]):
        if not scenes:
            raise ValueError("A mixture needs at least one scene, got none")
        self.scenes: list[Scene] = [SCENES.from_config(scene) for scene in scenes]
        kinds = sorted({(scene.data_range, scene.unit) for scene in self.scenes})
        if len(kinds) > 1:
            raise ValueError(
                f"The scenes of a mixture must share their data range and unit, got {kinds}"
            )
        ((self.data_range, self.unit),) = kinds

    @property
    def length(self) -> int | None:
        """Cases until every scene has been seen whole; None as soon as one is endless."""
        lengths = [scene.length for scene in self.scenes]
        finite = [n for n in lengths if n is not None]
        return len(lengths) * max(finite) if len(finite) == len(lengths) else None

    def thinnest(self, grid: Grid) -> float:
        """The least that any scene with such a figure states, in mm; infinite where none does."""
        sizes = [scene.thinnest(grid) for scene in self.scenes if isinstance(scene, Thin)]
        return min(sizes, default=math.inf)

    def sample(self, index: int, seed: int, grid: Grid, cameras: Rays) -> Sample:
        """The case `index` of the series `seed`, seen by `cameras`, with its truth on `grid`."""
        scene, case = self._case(index)
        return scene.sample(case, seed, grid, cameras)

    def finer(
        self, index: int, seed: int, grid: Grid, cameras: Rays, factor: int
    ) -> Float[Tensor, "1 d h w"]:
        """The case's values on `grid.refined(factor)`."""
        scene, case = self._case(index)
        return finer(scene, case, seed, grid, cameras, factor)

    def maps(
        self, index: int, seed: int, grid: Grid, factor: int = 1
    ) -> Mapping[str, Float[Tensor, "1 d h w"]]:
        """The maps of the case on `grid.refined(factor)`; none where its scene has none."""
        scene, case = self._case(index)
        return scene.maps(case, seed, grid, factor) if isinstance(scene, Mapped) else {}

    def _case(self, index: int) -> tuple[Scene, int]:
        turn, which = divmod(index, len(self.scenes))
        scene = self.scenes[which]
        return scene, index if scene.length is None else turn % scene.length
