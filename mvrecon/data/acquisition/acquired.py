"""A scene whose views come from a projector and a detector."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import avg_pool2d, avg_pool3d

from mvrecon.core.numbers import case_numbers, generator, mixed
from mvrecon.core.parts import PROJECTORS, ProjectorPart
from mvrecon.data.acquisition.breathing import breathing_views, check_amplitude
from mvrecon.data.acquisition.detector import Acquisition, measured
from mvrecon.data.acquisition.disturbances import rig_errors
from mvrecon.data.dataset import CaseStore
from mvrecon.data.scenes.sample import Sample, Scene
from mvrecon.geometry.cameras.camera import Cameras
from mvrecon.geometry.grid import Grid
from mvrecon.operators.operator import PixelIntegral, Projector, sees_integrals

#: Random series of detector and rig errors, apart from that of the objects.
NOISE, ERRORS = 0x6E6F6973, 0x72696773


class Lines(NamedTuple):
    """Pixels that are weighted line integrals, which the scene computes along the rays of `rig`:
    the run's own, or its pixels subdivided.
    """

    rig: Cameras
    pixel: PixelIntegral


class Projection(NamedTuple):
    """A projector on the finer grid for the views, with `rays` of its pixels each way in one of the
    run's.
    """

    operator: Projector
    rays: int


class Acquired(Scene):
    """A scene whose views are those of an acquisition, in the projector's unit.

    A projector whose pixels consist of line integrals (`pixel_integral`) uses the scene's own; any
    other is built on a finer grid, and projects the object there. Case, true volume and name are
    the scene's. The noise is a function of (seed, index). If a scene has a map of a case by the
    name of one of the projector's options, such as its attenuation, the map replaces the option's
    value, which is a reconstruction's assumption. A breathing object is deformed on the finer grid.

    Args:
        scene: the objects.
        projector: name and options; None: line integrals.
        acquisition: the detector.
        store: caches noiseless cases; None: all are recomputed.

    Raises:
        ValueError: a breathing object without a projector, or with closed-form integrals.
    """

    def __init__(
        self,
        scene: Scene,
        projector: ProjectorPart | None = None,
        acquisition: Acquisition | None = None,
        store: CaseStore | None = None,
    ):
        self.scene, self.projector = scene, None if projector is None else dict(projector)
        self.data_range, self.unit, self.length = scene.data_range, scene.unit, scene.length
        self.acquisition, self.store = acquisition or Acquisition(), store
        self._source: tuple[Grid, Cameras, Lines | Projection] | None = None
        disturbed, closed_form = self.acquisition.disturbed, self.acquisition.closed_form
        if disturbed and disturbed.breathing_mm and (projector is None or closed_form):
            name = None if projector is None else projector["name"]
            raise ValueError(
                f"An object with disturbed.breathing_mm is deformed on the finer grid: expected a "
                f"projector and acquisition.closed_form=false, got projector {name} and "
                f"closed_form {closed_form}"
            )

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_source": None}

    def unit_of_views(self, grid: Grid, cameras: Cameras) -> str:
        """Unit of the views: that of line integrals, or the projector's own."""
        source = self._source_of(grid, cameras)
        if isinstance(source, Projection):
            integrals = sees_integrals(source.operator)
        else:
            integrals = bool((source.pixel.weight == 1).all())
        if integrals:
            return f"{self.unit} * mm"
        return f"{(self.projector or {}).get('name')} of {self.unit}"

    def sample(self, index: int, seed: int, grid: Grid, cameras: Any) -> Sample:
        """The case `index` of the series `seed`, measured by `cameras`, with its truth on `grid`.

        Raises:
            ValueError: a projector that supports neither the finer grid nor finer pixels with it;
                breathing that could fold an object of this grid, or without its attenuation.
        """
        errors, rig, amplitudes = None, cameras, ()
        if (disturbed := self.acquisition.disturbed) is not None:
            check_amplitude(grid, disturbed.breathing_mm)
            errors = rig_errors(disturbed, cameras, generator(ERRORS, mixed(seed, index)))
            rig, amplitudes = errors.rig(cameras), tuple(errors.breathing_mm.tolist())
        case = index, seed, grid, rig, amplitudes
        if self.store is None:
            sample, _ = self.ideal(*case)
        else:
            sample = self.store(*case, lambda: self.ideal(*case)[0])
        noise = generator(NOISE, mixed(seed, index))
        if errors is None:
            views, dose = measured(sample.views, self.acquisition, cameras, noise)
            return replace(sample, views=views, dose=dose)
        scatter = errors.scatter[:, None, None]
        disturbed = errors.views(sample.views)
        views, dose = measured(disturbed, self.acquisition, cameras, noise, sample.views, scatter)
        return replace(sample, views=errors.read(views), dose=dose, errors=errors.record())

    def ideal(
        self,
        index: int,
        seed: int,
        grid: Grid,
        rig: Any,
        amplitudes_mm: Sequence[float] = (),
    ) -> tuple[Sample, Float[Tensor, "1 d h w"] | None]:
        """Return the case as a perfect detector measures it, and the object on the finer grid that
        was projected; None for integrals in closed form.

        Args:
            index, seed, grid: see `sample`.
            rig: the true cameras.
            amplitudes_mm: amplitude of the breathing object in each view, in mm; empty: at rest in
                all.

        Raises:
            ValueError: as `sample`.
        """
        scene, fine = self.scene, self.acquisition.fine
        maps: dict[str, Float[Tensor, "1 d h w"]] = {}
        if self.projector is not None and scene.map_names:
            name, known = self.projector["name"], scene.maps(index, seed, grid, fine)
            maps = {key: values for key, values in known.items() if PROJECTORS.takes(name, key)}
        source = self._source_of(grid, rig, maps)
        if isinstance(source, Lines):
            sample = scene.sample(index, seed, grid, source.rig)
            views = avg_pool2d(sample.views, source.pixel.rays)
            return replace(sample, views=views * source.pixel.weight.to(views)), None
        with case_numbers(seed, index):  # a scene may draw from the global generator
            volume = scene.finer(index, seed, grid, rig, fine)
        with case_numbers(seed, index):
            sample = scene.pooled(index, seed, grid, rig, volume)
        with torch.no_grad():
            views = breathing_views(source.operator, volume, amplitudes_mm)
            views = avg_pool2d(views, source.rays).to(torch.float32)
        pooled = {key: avg_pool3d(values[None], fine)[0] for key, values in maps.items()}
        return replace(sample, views=views, maps={**sample.maps, **pooled}), volume

    def _source_of(
        self, grid: Grid, rig: Any, maps: Mapping[str, Float[Tensor, "1 d h w"]] | None = None
    ) -> Lines | Projection:
        """The source of the views, cached across cases unless it depends on the case."""
        if self.projector is None:
            return Lines(rig, PixelIntegral())
        if not maps and self._source is not None:
            if self._source[0] is grid and self._source[1] is rig:
                return self._source[2]
        acting = {key: values[0] if values.any() else None for key, values in (maps or {}).items()}
        exact = self.acquisition.closed_form and all(values is None for values in acting.values())
        fine, rays = self.acquisition.fine, self.acquisition.rays
        source = source_of({**self.projector, **acting}, grid, rig, fine, exact, rays)
        if isinstance(source, Projection) and not self.scene.map_names:
            source.operator.for_case({})  # raises for cases without required maps
        if not maps and self.acquisition.disturbed is None:
            self._source = (grid, rig, source)
        return source


def source_of(
    projector: ProjectorPart,
    grid: Grid,
    cameras: Cameras,
    fine: int,
    closed_form: bool = True,
    rays: int = 1,
) -> Lines | Projection:
    """Return the source of the views: line integrals, or the projector on a grid `fine` times
    finer.

    A projector that does not support the finer grid with the detector's own pixels gets finer
    pixels, which are then averaged.

    Args:
        projector: name and options.
        grid: grid of the true volume.
        cameras: cameras of the run.
        fine: refinement factor of the projector's grid.
        closed_form: use the scene's own line integrals for projectors of these.
        rays: finer pixels each way in one, on the finer grid, if the projector supports them.

    Raises:
        ValueError: the projector does not support this either.
    """
    if closed_form:
        A = PROJECTORS.from_config(projector, grid=grid, cameras=cameras)
        if (pixel := A.pixel_integral()) is not None:
            return Lines(cameras if pixel.rays == 1 else cameras.refined(pixel.rays), pixel)
    refusals = []
    for cut in dict.fromkeys((rays, fine)):
        rig = cameras if cut == 1 else cameras.refined(cut)
        try:
            operator = PROJECTORS.from_config(projector, grid=grid.refined(fine), cameras=rig)
            return Projection(operator, cut)
        except ValueError as error:
            refusals.append(str(error))
    raise ValueError(
        f"The projector {projector['name']!r} cannot make views on a grid {fine} times finer "
        f"(acquisition.fine): {refusals[0]}"
        + (f"; nor with pixels {fine} times finer: {refusals[1]}" if len(set(refusals)) > 1 else "")
    )
