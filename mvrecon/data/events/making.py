"""One random event: a pure function of (settings, seed, index)."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from mvrecon.acquisition.acquired import NOISE, Acquired
from mvrecon.acquisition.detector import counted, emitted
from mvrecon.acquisition.settings import Acquisition
from mvrecon.cameras.camera import Cameras
from mvrecon.data.events.settings import EventSettings
from mvrecon.data.events.sinograms import Sinograms
from mvrecon.geometry.grid import Grid
from mvrecon.parts import CAMERAS, PROJECTORS, SCENES
from mvrecon.projectors.operator import Projector
from mvrecon.scenes.analytic import generator, mixed, uniform
from mvrecon.scenes.sample import Parametrised, finer

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
