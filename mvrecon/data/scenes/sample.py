"""Scenes, their samples (measured views and true volume of a case), and mixtures of scenes."""

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal, Protocol

from jaxtyping import Bool, Float, Shaped
from torch import Tensor

from mvrecon.core.numbers import data_range_of
from mvrecon.core.parts import SCENES, ScenePart
from mvrecon.geometry.grid import Grid


class Rays(Protocol):
    """The part of a rig's rays that a scene needs."""

    @property
    def ray_extent(self) -> tuple[float, float]:
        """The range of a ray's fractions w."""
        ...

    def rays(self) -> tuple[Float[Tensor, "m v u 3"], Float[Tensor, "m v u 3"]]:
        """The points of each pixel's ray at w = 0 and w = 1, in world mm."""
        ...


@dataclass(frozen=True, eq=False)
class Sample:
    """One case.

    Args:
        views: line integrals in value * mm, float32; those of an acquisition in its projector's
            unit.
        volume: true values on the grid, float32.
        inside: the voxels that the object touches.
        name: name of the case, the same for the same (seed, index).
        errors: unknown errors of each view by name, or empty.
        maps: further volumes of the case on the grid by name, such as its attenuation; part of a
            batch under their names.
        dose: expected counts per unit of the views, whose product with it are counts; None: views
            that are no counts.
    """

    views: Float[Tensor, "1 m v u"]
    volume: Float[Tensor, "1 d h w"]
    inside: Bool[Tensor, "1 d h w"]
    name: str
    errors: Mapping[str, Shaped[Tensor, "m *n"]] = field(default_factory=dict)
    maps: Mapping[str, Float[Tensor, "1 d h w"]] = field(default_factory=dict)
    dose: float | None = None


class Scene(ABC):
    """A source of cases; each is a pure function of (seed, index), in any order and from any
    process. Subclasses implement `data_range`, `unit` and `sample`.

    Attributes:
        data_range: the fixed range of values for PSNR and SSIM.
        unit: unit of the volume's values.
        length: number of cases; None: unlimited.
        map_names: names of the further volumes of `maps`, such as "mu".
        vary: cases beyond the last one are varied copies.
        keeps: keep volumes in memory after reading.
    """

    data_range: float
    unit: str
    length: int | None = None
    map_names: tuple[str, ...] = ()
    vary: bool | Literal["exact"] = False
    keeps: bool = False

    @abstractmethod
    def sample(self, index: int, seed: int, grid: Grid, cameras: Any) -> Sample:
        """Return the case `index` of the series `seed`, seen by `cameras` (`Rays`), with its true
        volume on `grid`.

        Raises:
            IndexError: the scene has no such case.
        """

    def finer(
        self, index: int, seed: int, grid: Grid, cameras: Any, factor: int
    ) -> Float[Tensor, "1 d h w"]:
        """Return the object of the case on `grid.refined(factor)`."""
        return self.sample(index, seed, grid.refined(factor), cameras).volume

    def pooled(
        self, index: int, seed: int, grid: Grid, cameras: Any, fine: Float[Tensor, "1 d h w"]
    ) -> Sample:
        """Return the case with arbitrary views, its true volume that of `sample` or averaged from
        the values `fine` of `finer`.
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
        """The random parameters of a case by name, such as its pose in mm and degrees; the same
        names for every case.
        """
        return {}

    def placement(self, index: int, seed: int, grid: Grid) -> Float[Tensor, "4 4"] | None:
        """The affine map in mm from a file's world to the case's; None for a scene
        without files.
        """
        return None

    def seed_of(self, index: int, seed: int) -> int:
        """The seed on which the case `index` of the series `seed` depends."""
        return seed


def phantom(
    name: str, grid: Grid, cameras: Rays, case: int = 0, seed: int = 0, **options: Any
) -> Sample:
    """One case of a scene, such as a phantom, with its views: exact line integrals.

    Args:
        name: name of the scene, such as "shepp_logan", "ellipsoids" (random) or "derenzo";
            `mvrecon-list scene` prints all.
        grid: grid of the true volume.
        cameras: the rig that sees it.
        case: number of the case, of a scene with several.
        seed: seed of the random scenes.
        options: options of the scene, such as `value`: the greatest value, 0.02 for water in 1/mm.

    Returns:
        A `Sample`: `views` [1 m v u] in value * mm and the true `volume` [1 d h w], both float32.

    Raises:
        LookupError: an unknown name.
        TypeError, ValueError: unknown or invalid options.
        IndexError: the scene has no such case.

    Examples:
        >>> grid = mv.Grid.centred(16, spacing=4.0)
        >>> cameras = mv.circular(6, 400.0, 800.0, {"pixels": [24, 24], "pixel_mm": 7.0})
        >>> scan = mv.phantom("shepp_logan", grid, cameras, value=0.02)
        >>> scan.views.shape, scan.volume.shape
        (torch.Size([1, 6, 24, 24]), torch.Size([1, 16, 16, 16]))
    """
    return SCENES.build(name, **options).sample(case, seed, grid, cameras)


class Mixture(Scene):
    """Cases of several scenes in turn: case i comes from scene i mod n. Shorter scenes repeat.

    Args:
        scenes: the configuration `{name: ..., **options}` of each scene.

    Raises:
        ValueError: no scenes, or scenes whose data range or unit differ.
    """

    def __init__(self, scenes: Sequence[ScenePart]):
        if not scenes:
            raise ValueError("A mixture needs at least one scene, got none")
        self.scenes: list[Scene] = [SCENES.from_config(scene) for scene in scenes]
        kinds = sorted({(data_range_of(scene.data_range), scene.unit) for scene in self.scenes})
        if len(kinds) > 1:
            raise ValueError(
                f"The scenes of a mixture must share their data range and unit, got {kinds}"
            )
        ((self.data_range, self.unit),) = kinds
        self.map_names = tuple(sorted({name for scene in self.scenes for name in scene.map_names}))

    @property
    def length(self) -> int | None:
        """Cases until every scene has been used entirely; None if one is unlimited."""
        lengths = [scene.length for scene in self.scenes]
        finite = [n for n in lengths if n is not None]
        return len(lengths) * max(finite) if len(finite) == len(lengths) else None

    def sample(self, index: int, seed: int, grid: Grid, cameras: Any) -> Sample:
        """Return the case `index` of the series `seed`, seen by `cameras`, with its true volume."""
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
