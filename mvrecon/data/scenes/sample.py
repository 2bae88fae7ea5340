"""Scenes, and the samples that they make: the measured views of a case and the true volume."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Protocol, runtime_checkable

from jaxtyping import Bool, Float, Shaped
from torch import Tensor

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


class Scene(Protocol):
    """A source of cases; each is a pure function of (seed, index), in any order and from any
    process.
    """

    @property
    def data_range(self) -> float:
        """The fixed range of values that PSNR and SSIM refer to."""
        ...

    @property
    def unit(self) -> str:
        """Unit of the volume's values."""
        ...

    @property
    def length(self) -> int | None:
        """How many cases there are; None: endless."""
        ...

    def sample(self, index: int, seed: int, grid: Grid, cameras: Rays) -> Sample:
        """The case `index` of the series `seed`, seen by `cameras`, with its truth on `grid`."""
        ...


@runtime_checkable
class Thin(Protocol):
    """A scene that states the least width of the bodies in it."""

    def thinnest(self, grid: Grid) -> float:
        """The least width in mm of any body in any case on `grid`."""
        ...


@runtime_checkable
class Placing(Protocol):
    """A scene that moves the objects of its files to where its cases are."""

    def placement(self, index: int, seed: int, grid: Grid) -> Float[Tensor, "4 4"]:
        """The affine map in mm that carries points of the file's world to the case's."""
        ...


@runtime_checkable
class Parametrised(Protocol):
    """A scene that states what was drawn at random for a case."""

    def parameters(self, index: int, seed: int, grid: Grid) -> dict[str, float]:
        """Numbers of the case `index` of the series `seed` by name, as its pose in mm and
        degrees; the same names for every case.
        """
        ...


@runtime_checkable
class Mapped(Protocol):
    """A scene whose cases have further volumes, such as what attenuates the emission."""

    def maps(
        self, index: int, seed: int, grid: Grid, factor: int = 1
    ) -> Mapping[str, Float[Tensor, "1 d h w"]]:
        """The true maps of the case `index` of the series `seed` by name, on
        `grid.refined(factor)`. A projector with an option of a map's name measures the case with
        the map.
        """
        ...


@runtime_checkable
class Finer(Protocol):
    """A scene that gives the object of a case on a finer grid without its views."""

    def finer(
        self, index: int, seed: int, grid: Grid, cameras: Rays, factor: int
    ) -> Float[Tensor, "1 d h w"]:
        """The values of the case `index` of the series `seed`, which `sample` puts on `grid`, on
        `grid.refined(factor)`.
        """
        ...


@runtime_checkable
class Pooling(Protocol):
    """A scene that makes a case of its object on a finer grid."""

    def pooled(self, index: int, seed: int, grid: Grid, fine: Float[Tensor, "1 d h w"]) -> Sample:
        """The case without views, its truth on `grid` averaged from the values on a finer one."""
        ...


def finer(
    scene: Scene, index: int, seed: int, grid: Grid, cameras: Rays, factor: int
) -> Float[Tensor, "1 d h w"]:
    """The object of a case on `grid.refined(factor)`; a scene that has no method for it samples the
    case on that grid.
    """
    if isinstance(scene, Finer):
        return scene.finer(index, seed, grid, cameras, factor)
    return scene.sample(index, seed, grid.refined(factor), cameras).volume
