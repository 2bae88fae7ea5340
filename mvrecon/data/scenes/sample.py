"""Scenes, the samples that they make (the measured views of a case and the true volume), and a
mixture of scenes.
"""

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal, Protocol

from jaxtyping import Bool, Float, Shaped
from torch import Tensor

from mvrecon.core.parts import SCENES
from mvrecon.geometry.grid import Grid


class Rays(Protocol):
    """The rays of a rig, as far as a scene needs them."""

    @property
    def ray_extent(self) -> tuple[float, float]:
        """The fractions w of a ray between which it counts."""
        ...

    def rays(self) -> tuple[Float[Tensor, "m v u 3"], Float[Tensor, "m v u 3"]]:
        """Where each pixel's ray has w = 0 and where it has w = 1, in world mm."""
        ...


@dataclass(frozen=True, eq=False)
class Sample:
    """One case.

    Args:
        views: line integrals in value * mm, float32; those of an acquisition are in its projector's
            unit.
        volume: truth on the grid, float32.
        inside: the voxels that the object touches.
        name: of the case, the same for the same (seed, index).
        errors: what is wrong with each view and nobody knows, by name; empty where nothing is.
        maps: further volumes of the case on the grid by name, such as its attenuation, which a
            batch holds under their names.
    """

    views: Float[Tensor, "1 m v u"]
    volume: Float[Tensor, "1 d h w"]
    inside: Bool[Tensor, "1 d h w"]
    name: str
    errors: Mapping[str, Shaped[Tensor, "m *n"]] = field(default_factory=dict)
    maps: Mapping[str, Float[Tensor, "1 d h w"]] = field(default_factory=dict)


class Scene(ABC):
    """A source of cases; each is a pure function of (seed, index), in any order and from any
    process. A subclass gives `data_range`, `unit` and `sample`; the rest has defaults.

    Attributes:
        data_range: the fixed range of values that PSNR and SSIM refer to.
        unit: of the volume's values.
        length: how many cases there are; None: endless.
        map_names: names of the further volumes that `maps` gives, such as "mu".
        vary: whether cases beyond the last one are varied copies.
        keeps: whether volumes that were read are kept in memory.
    """

    data_range: float
    unit: str
    length: int | None = None
    map_names: tuple[str, ...] = ()
    vary: bool | Literal["exact"] = False
    keeps: bool = False

    @abstractmethod
    def sample(self, index: int, seed: int, grid: Grid, cameras: Any) -> Sample:
        """The case `index` of the series `seed`, seen by `cameras` (`Rays`), with its truth on
        `grid`.

        Raises:
            IndexError: the scene has no such case.
        """

    def finer(
        self, index: int, seed: int, grid: Grid, cameras: Any, factor: int
    ) -> Float[Tensor, "1 d h w"]:
        """The object of the case that `sample` puts on `grid`, on `grid.refined(factor)`."""
        return self.sample(index, seed, grid.refined(factor), cameras).volume

    def pooled(
        self, index: int, seed: int, grid: Grid, cameras: Any, fine: Float[Tensor, "1 d h w"]
    ) -> Sample:
        """The case whose views do not matter, its truth that of `sample`, or averaged from the
        values `fine` that `finer` gave.
        """
        return self.sample(index, seed, grid, cameras)

    def maps(
        self, index: int, seed: int, grid: Grid, factor: int = 1
    ) -> Mapping[str, Float[Tensor, "1 d h w"]]:
        """The true maps of a case by name, on `grid.refined(factor)`. A projector with an option of
        a map's name measures the case with the map.
        """
        return {}

    def parameters(self, index: int, seed: int, grid: Grid) -> dict[str, float]:
        """Numbers that were drawn at random for a case by name, as its pose in mm and degrees; the
        same names for every case.
        """
        return {}

    def placement(self, index: int, seed: int, grid: Grid) -> Float[Tensor, "4 4"] | None:
        """The affine map in mm that carries points of a file's world to the case's; None where the
        scene reads no file.
        """
        return None

    def thinnest(self, grid: Grid) -> float:
        """The least width in mm of any body in any case on `grid`; infinite where none is known."""
        return math.inf

    def seed_of(self, index: int, seed: int) -> int:
        """The seed on which the case `index` of the series `seed` depends."""
        return seed


class Mixture(Scene):
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
        self.map_names = tuple(sorted({name for scene in self.scenes for name in scene.map_names}))

    @property
    def length(self) -> int | None:
        """Cases until every scene has been seen whole; None as soon as one is endless."""
        lengths = [scene.length for scene in self.scenes]
        finite = [n for n in lengths if n is not None]
        return len(lengths) * max(finite) if len(finite) == len(lengths) else None

    def thinnest(self, grid: Grid) -> float:
        """The least that any of the scenes states, in mm."""
        return min(scene.thinnest(grid) for scene in self.scenes)

    def sample(self, index: int, seed: int, grid: Grid, cameras: Any) -> Sample:
        """The case `index` of the series `seed`, seen by `cameras`, with its truth on `grid`."""
        scene, case = self._case(index)
        return scene.sample(case, seed, grid, cameras)

    def finer(
        self, index: int, seed: int, grid: Grid, cameras: Any, factor: int
    ) -> Float[Tensor, "1 d h w"]:
        """The case's values on `grid.refined(factor)`."""
        scene, case = self._case(index)
        return scene.finer(case, seed, grid, cameras, factor)

    def maps(
        self, index: int, seed: int, grid: Grid, factor: int = 1
    ) -> Mapping[str, Float[Tensor, "1 d h w"]]:
        """The maps of the case on `grid.refined(factor)`; none where its scene has none."""
        scene, case = self._case(index)
        return scene.maps(case, seed, grid, factor)

    def _case(self, index: int) -> tuple[Scene, int]:
        turn, which = divmod(index, len(self.scenes))
        scene = self.scenes[which]
        return scene, index if scene.length is None else turn % scene.length
