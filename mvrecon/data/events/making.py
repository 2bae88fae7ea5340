"""One random event: a pure function of (settings, seed, index)."""

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields, replace
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from mvrecon.core.parts import CAMERAS, PROJECTORS, SCENES
from mvrecon.core.random_numbers import generator, mixed, uniform
from mvrecon.core.registry import check_options
from mvrecon.data.acquisition.acquired import NOISE, Acquired
from mvrecon.data.acquisition.detector import counted, emitted
from mvrecon.data.acquisition.settings import Acquisition
from mvrecon.data.scenes.sample import Parametrised, finer
from mvrecon.geometry.cameras.camera import Cameras
from mvrecon.geometry.cameras.rigs import sinogram_rig
from mvrecon.geometry.grid import Grid
from mvrecon.operators.operator import Projector
from mvrecon.operators.radon import Radon


class Sinograms:
    """The Radon transform of all slices over the full circle, in (unit of the volume) * mm.

    Views that face each other are one, mirrored: with an even number of angles half of them are
    computed, to the last bit.

    Args:
        grid: of the slices that are asked for.
        fine: the volume's grid is this many times finer.
        angles: of the full circle.
        bins: columns; None: enough for the diagonal of a slice.
    """

    def __init__(self, grid: Grid, fine: int, angles: int, bins: int | None = None):
        rig = sinogram_rig(grid, angles, bins)
        self.mirrored = angles % 2 == 0
        half = rig[list(range(angles // 2))] if self.mirrored else rig
        self.operator = Radon(grid.refined(fine), half)
        self.shape = angles, *rig.shape

    def __call__(self, volume: Float[Tensor, "1 d h w"]) -> Float[Tensor, "a z s"]:
        with torch.no_grad():
            views = self.operator(volume[None])[0, 0]
        return torch.cat([views, views.flip(-1)]) if self.mirrored else views


@dataclass(frozen=True, kw_only=True)
class EventSettings:
    """How many events there are, in which files, and what is kept of each.

    Args:
        count: of events.
        first: index of the first one in its series; other folders may go on where one ends.
        shard: events in a file; the last one may have fewer.
        workers: processes that make shards beside this one, 0: none. No byte depends on it.
        totals: least and greatest expected counts of an event, its own drawn between them, uniform
            in the logarithm. None: `acquisition.counts` for all.
        angles: of the sinograms over the full circle; 0: none are kept.
        bins: of the sinograms; None: enough for the diagonal of a slice.
        backprojection: whether the counts' back-projection is kept, too.

    Raises:
        TypeError: an option that is no number.
        ValueError: numbers that are too small.
    """

    count: int
    first: int = 0
    shard: int = 32
    workers: int = 2
    totals: tuple[float, float] | None = None
    angles: int = 256
    bins: int | None = None
    backprojection: bool = False

    def __post_init__(self) -> None:
        least = {"count": 1, "first": 0, "shard": 1, "workers": 0, "angles": 0, "bins": 1}
        for name, value in asdict(self).items():
            if name in ("totals", "backprojection") or (name == "bins" and value is None):
                continue
            if not isinstance(value, int) or isinstance(value, bool):
                raise TypeError(f"Expected events.{name} as a whole number, got {value!r}")
            if value < least[name]:
                raise ValueError(f"Expected events.{name} of at least {least[name]}, got {value}")
        if self.totals is not None:
            low, high = self.totals
            if not 0 < low <= high < float("inf"):
                raise ValueError(f"Expected events.totals that ascend above 0, got {low}, {high}")

    @classmethod
    def of(cls, options: Mapping[str, Any]) -> "EventSettings":
        """The settings that a mapping describes.

        Raises:
            TypeError: an unknown option, or one without a default that is missing.
        """
        check_options("A data set of events", options, [field.name for field in fields(cls)])
        values = dict(options)
        if values.get("totals") is not None:
            values["totals"] = tuple(float(total) for total in values["totals"])
        return cls(**values)

    @property
    def shards(self) -> int:
        """How many files there are."""
        return -(-self.count // self.shard)

    def indices(self, shard: int) -> range:
        """Indices, in their series, of the events in a file."""
        start = self.first + shard * self.shard
        return range(start, min(start + self.shard, self.first + self.count))


#: The series of the random numbers of doses.
DOSES = 0x646F7365
#: The largest number in a bin of counts.
MOST = 2**32 - 1
Arrays = dict[str, np.ndarray]


class BackProjection(NamedTuple):
    """Counts back-projected and divided by their sensitivity, in activity: A^T y / (dose A^T 1).

    Args:
        operator: A, without attenuation.
        sensitivity: A^T 1; zero where nothing is seen.
    """

    operator: Projector
    sensitivity: Float[Tensor, "1 1 d h w"]

    @classmethod
    def of(
        cls, projector: Mapping[str, Any] | None, grid: Grid, cameras: Cameras
    ) -> "BackProjection":
        """That of a projector by its name and options.

        Raises:
            ValueError: no projector.
        """
        if projector is None:
            raise ValueError("Expected a projector for events.backprojection, got none")
        A = PROJECTORS.from_config(projector, grid=grid, cameras=cameras)
        with torch.no_grad():
            return cls(A, A.T(torch.ones(1, 1, *A.range_shape)))

    def __call__(self, number: Float[Tensor, "1 m v u"], dose: float) -> Float[Tensor, "d h w"]:
        with torch.no_grad():
            sums = self.operator.T(number[None].float())
        weight = self.sensitivity * dose
        return torch.where(weight > 0, sums / weight, 0.0)[0, 0]


@dataclass
class EventMaker:
    """Makes events of a scene, seen by cameras, counted by a detector.

    Args:
        scene: the objects and what measures them.
        grid: of the truth.
        cameras: that see them.
        seed: the series of cases.
        settings: of the data set.

    Raises:
        ValueError: an acquisition without counts, with rig errors, or with electronic noise.
    """

    scene: Acquired
    grid: Grid
    cameras: Cameras
    seed: int
    settings: EventSettings

    def __post_init__(self) -> None:
        acquisition = self.scene.acquisition
        if self.settings.totals is None and acquisition.counts is None:
            raise ValueError(
                "Expected the counts of an event as acquisition.counts or events.totals, got none"
            )
        if acquisition.photons is not None or acquisition.disturbed is not None:
            raise ValueError(
                f"Expected an acquisition of counts without rig errors, got photons "
                f"{acquisition.photons} and disturbed {acquisition.disturbed}"
            )
        if acquisition.noise:
            raise ValueError(
                f"Expected whole counts without electronic noise, got noise {acquisition.noise}"
            )
        angles, bins, fine = self.settings.angles, self.settings.bins, acquisition.fine
        self.sinograms = Sinograms(self.grid, fine, angles, bins) if angles else None
        self.volumes = None
        if self.settings.backprojection:
            self.volumes = BackProjection.of(self.scene.projector, self.grid, self.cameras)

    @classmethod
    def of(cls, settings: Mapping[str, Any]) -> "EventMaker":
        """The events that the settings of an app describe."""
        grid, cameras = Grid.centred(**settings["grid"]), CAMERAS.from_config(settings["camera"])
        scene = SCENES.from_config(settings["scene"])
        acquired = Acquired(scene, settings["projector"], Acquisition.of(settings["acquisition"]))
        return cls(acquired, grid, cameras, settings["seed"], EventSettings.of(settings["events"]))

    @property
    def columns(self) -> tuple[str, ...]:
        """Names of the numbers that were drawn for an event."""
        scene, first = self.scene.scene, self.settings.first
        if not isinstance(scene, Parametrised):
            return ()
        return tuple(scene.parameters(first, self.seed, self.grid))

    def __call__(self, index: int) -> Arrays:
        """The arrays of one event by name; see `mvrecon.data.events.shards`.

        Raises:
            ValueError: values that are not finite, negative views, or more counts in a bin than a
                file holds.
        """
        seen = self.scene.seen(index, self.seed, self.grid, self.cameras)
        sample, acquisition = seen.sample, self._dosed(index)
        for name, values in (("views", sample.views), ("volume", sample.volume)):
            if not values.isfinite().all():
                raise ValueError(f"{sample.name}: expected finite {name}, got values that are not")
        ideal = emitted(sample.views, acquisition, self.cameras)
        number, dose = counted(ideal, acquisition, generator(NOISE, mixed(self.seed, index)))
        if number.max() > MOST:
            raise ValueError(f"Expected at most {MOST} counts in a bin, got {number.max():.0f}")
        arrays = {
            "truth": sample.volume[0].numpy(),
            "ideal": sample.views[0].numpy(),
            "counts": number[0].numpy().astype(np.uint32),
            "dose": np.float64(dose),
            "index": np.int64(index),
        }
        if self.volumes is not None:
            arrays["backprojection"] = self.volumes(number, dose).numpy()
        arrays |= {name: values[0].numpy() for name, values in sample.maps.items()}
        if self.sinograms is not None:
            fine = seen.fine if seen.fine is not None else self._finer(index)
            arrays["radon"] = self.sinograms(fine).numpy()
        if isinstance(self.scene.scene, Parametrised):
            drawn = self.scene.scene.parameters(index, self.seed, self.grid)
            arrays["pose"] = np.array(list(drawn.values()), dtype=np.float64)
        return arrays

    def _dosed(self, index: int) -> Acquisition:
        """The acquisition with the expected counts of one event."""
        if self.settings.totals is None:
            return self.scene.acquisition
        low, high = (math.log(total) for total in self.settings.totals)
        rng = generator(DOSES, mixed(self.seed, index))
        return replace(self.scene.acquisition, counts=math.exp(uniform(rng, low, high)))

    def _finer(self, index: int) -> torch.Tensor:
        fine = self.scene.acquisition.fine
        return finer(self.scene.scene, index, self.seed, self.grid, self.cameras, fine)
