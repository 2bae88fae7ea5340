"""A scene whose views are made by a projector and a detector."""

import math
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any, NamedTuple, Protocol

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import avg_pool2d, avg_pool3d

from mvrecon.core.parts import PROJECTORS
from mvrecon.core.random_numbers import case_numbers, generator, mixed
from mvrecon.data.acquisition.detector import detected
from mvrecon.data.acquisition.disturbances import rig_errors
from mvrecon.data.acquisition.settings import Acquisition
from mvrecon.data.scenes.sample import Mapped, Placing, Pooling, Sample, Scene, Thin, finer
from mvrecon.geometry.cameras.camera import Cameras
from mvrecon.geometry.grid import Grid
from mvrecon.operators.operator import PixelIntegral, Projector

#: The series of the random numbers of the detector and of rig errors, apart from those that draw
#: the objects.
NOISE, ERRORS = 0x6E6F6973, 0x72696773


class Lines(NamedTuple):
    """Pixels that are weighted line integrals, which the scene makes along the rays of `rig`: the
    run's own, or its pixels cut into several.
    """

    rig: Cameras
    pixel: PixelIntegral


class Projection(NamedTuple):
    """A projector on the finer grid that makes the views, with `rays` of its pixels each way in one
    of the run's.
    """

    operator: Projector
    rays: int


class Seen(NamedTuple):
    """A case as a perfect detector measures it.

    Args:
        sample: the case.
        fine: the object on the finer grid that its views were projected from; none where they are
            integrals in closed form.
    """

    sample: Sample
    fine: Float[Tensor, "1 d h w"] | None = None


class Store(Protocol):
    """Where cases are kept, as a perfect detector measures them."""

    def __call__(
        self, index: int, seed: int, grid: Grid, cameras: Any, make: Callable[[], Sample]
    ) -> Sample:
        """The case that is kept, or else the one that `make` makes."""
        ...


class Acquired:
    """A scene whose views are those of an acquisition, in the projector's unit.

    A projector that says how its pixels are made of line integrals (`pixel_integral`) takes the
    scene's own; any other is built anew on a finer grid, and sees the object there. Case, truth and
    name are the scene's. The noise is a function of (seed, index). Where a scene has a map of a
    case by the name of one of the projector's options, such as its attenuation, the map stands for
    the option's value, which is the assumption of a reconstruction.

    Args:
        scene: the objects.
        projector: name and options; None: line integrals.
        acquisition: the detector.
        store: keeps cases as a perfect detector measures them; none: all are made anew.
    """

    def __init__(
        self,
        scene: Scene,
        projector: Mapping[str, Any] | None = None,
        acquisition: Acquisition | None = None,
        store: Store | None = None,
    ):
        self.scene, self.projector = scene, None if projector is None else dict(projector)
        self.acquisition, self.store = acquisition or Acquisition(), store
        self._source: tuple[Grid, Cameras, Lines | Projection] | None = None

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_source": None}

    @property
    def data_range(self) -> float:
        """The fixed range of values that PSNR and SSIM refer to."""
        return self.scene.data_range

    @property
    def unit(self) -> str:
        """Unit of the volumes' values."""
        return self.scene.unit

    @property
    def length(self) -> int | None:
        """How many cases there are; None: endless."""
        return self.scene.length

    def thinnest(self, grid: Grid) -> float:
        """The least width in mm of any body in any case on `grid`; infinite where none is known."""
        return self.scene.thinnest(grid) if isinstance(self.scene, Thin) else math.inf

    def placement(self, index: int, seed: int, grid: Grid) -> Float[Tensor, "4 4"] | None:
        """The affine map in mm that carries points of the file's world to the case's; None where
        the scene reads no file.
        """
        return self.scene.placement(index, seed, grid) if isinstance(self.scene, Placing) else None

    def unit_of_views(self, grid: Grid, cameras: Cameras) -> str:
        """Unit of the views: that of line integrals, or the projector's own."""
        source = self._source_of(grid, cameras)
        if isinstance(source, Lines) and bool((source.pixel.weight == 1).all()):
            return f"{self.unit} * mm"
        return f"{(self.projector or {}).get('name')} of {self.unit}"

    def sample(self, index: int, seed: int, grid: Grid, cameras: Any) -> Sample:
        """The case `index` of the series `seed`, measured by `cameras`, with its truth on `grid`.

        Raises:
            ValueError: a projector that takes neither the finer grid nor finer pixels with it.
        """
        rng, errors, rig = generator(NOISE, mixed(seed, index)), None, cameras
        if self.acquisition.disturbed is not None:
            drawn = generator(ERRORS, mixed(seed, index))
            errors = rig_errors(self.acquisition.disturbed, cameras, drawn)
            rig = errors.rig(cameras)

        def ideal() -> Sample:
            return self._ideal(index, seed, grid, rig)

        sample = self.store(index, seed, grid, rig, ideal) if self.store else ideal()
        if errors is not None:
            sample = replace(sample, views=errors.views(sample.views), errors=errors.record())
        return replace(sample, views=detected(sample.views, self.acquisition, cameras, rng))

    def _ideal(self, index: int, seed: int, grid: Grid, rig: Any) -> Sample:
        return self.seen(index, seed, grid, rig).sample

    def seen(self, index: int, seed: int, grid: Grid, rig: Any) -> Seen:
        """The case as a perfect detector measures it, before any rig errors.

        Raises:
            ValueError: as `sample`.
        """
        maps = self._maps(index, seed, grid)
        source = self._source_for(maps, grid, rig)
        if isinstance(source, Lines):
            sample = self.scene.sample(index, seed, grid, source.rig)
            views = _pooled(sample.views, source.pixel.rays)
            return Seen(replace(sample, views=views * source.pixel.weight.to(views)))
        with case_numbers(seed, index):  # a scene may draw from the global ones
            volume = finer(self.scene, index, seed, grid, rig, self.acquisition.fine)
        if isinstance(self.scene, Pooling):
            sample = self.scene.pooled(index, seed, grid, volume)
        else:
            with case_numbers(seed, index):
                sample = self.scene.sample(index, seed, grid, rig)
        with torch.no_grad():
            views = _pooled(source.operator(volume[None])[0], source.rays).to(torch.float32)
        pooled = {
            name: avg_pool3d(values[None], self.acquisition.fine)[0]
            for name, values in maps.items()
        }
        return Seen(replace(sample, views=views, maps={**sample.maps, **pooled}), volume)

    def _maps(self, index: int, seed: int, grid: Grid) -> dict[str, Float[Tensor, "1 d h w"]]:
        """The maps of a case that the projector takes, on the finer grid."""
        if self.projector is None or not isinstance(self.scene, Mapped):
            return {}
        maps = self.scene.maps(index, seed, grid, self.acquisition.fine)
        name = self.projector["name"]
        return {option: maps[option] for option in maps if PROJECTORS.takes(name, option)}

    def _source_for(
        self, maps: Mapping[str, Float[Tensor, "1 d h w"]], grid: Grid, rig: Any
    ) -> Lines | Projection:
        if maps or self.acquisition.disturbed is not None:  # of this case alone
            acting = {name: values[0] if values.any() else None for name, values in maps.items()}
            return self._made(acting, grid, rig)
        return self._source_of(grid, rig)

    def _source_of(self, grid: Grid, cameras: Cameras) -> Lines | Projection:
        if self._source is None or self._source[0] is not grid or self._source[1] is not cameras:
            self._source = (grid, cameras, self._made({}, grid, cameras))
        return self._source[2]

    def _made(
        self, maps: Mapping[str, Float[Tensor, "d h w"] | None], grid: Grid, cameras: Cameras
    ) -> Lines | Projection:
        projector, acquisition = self.projector, self.acquisition
        if projector is None:
            return source_of(None, grid, cameras, acquisition.fine)
        acts = any(values is not None for values in maps.values())
        make = source_of if acquisition.closed_form and not acts else projection_of
        source = make({**projector, **maps}, grid, cameras, acquisition.fine)
        if isinstance(source, Projection) and not isinstance(self.scene, Mapped):
            source.operator.for_case({})  # refuses cases without the maps that it needs
        return source


def source_of(
    projector: Mapping[str, Any] | None, grid: Grid, cameras: Cameras, fine: int
) -> Lines | Projection:
    """What makes the views: line integrals, or the projector on a grid `fine` times finer.

    A projector that refuses the finer grid under the detector's own pixels gets finer pixels, too,
    which are then averaged.

    Raises:
        ValueError: the projector refuses this as well.
    """
    if projector is None:
        return Lines(cameras, PixelIntegral())
    A = PROJECTORS.from_config(projector, grid=grid, cameras=cameras)
    if (pixel := A.pixel_integral()) is not None:
        return Lines(cameras if pixel.rays == 1 else cameras.refined(pixel.rays), pixel)
    return projection_of(projector, grid, cameras, fine)


def projection_of(
    projector: Mapping[str, Any], grid: Grid, cameras: Cameras, fine: int
) -> Projection:
    """The projector on a grid `fine` times finer, with finer pixels where it needs them.

    Raises:
        ValueError: the projector refuses this as well.
    """
    refusals = []
    for rays in (1, fine):
        rig = cameras if rays == 1 else cameras.refined(rays)
        try:
            operator = PROJECTORS.from_config(projector, grid=grid.refined(fine), cameras=rig)
            return Projection(operator, rays)
        except ValueError as error:
            refusals.append(str(error))
    raise ValueError(
        f"The projector {projector['name']!r} cannot make views on a grid {fine} times finer "
        f"(acquisition.fine): {refusals[0]}"
        + (f"; nor with pixels {fine} times finer: {refusals[1]}" if len(set(refusals)) > 1 else "")
    )


def _pooled(views: Float[Tensor, "1 m v u"], rays: int) -> Float[Tensor, "1 m v u"]:
    return views if rays == 1 else avg_pool2d(views, rays)
