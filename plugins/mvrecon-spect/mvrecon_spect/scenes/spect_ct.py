"""Cases of SPECT/CT: patients with attenuation measured by a transmission scan."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from mvrecon.core.numbers import generator, mixed
from mvrecon.core.parts import CAMERAS, SCENES, CameraPart, ScenePart
from mvrecon.data.acquisition.detector import Acquisition, detected
from mvrecon.data.attenuation import CT_KEV, SPECT_KEV, attenuation, hounsfield, tissue_at
from mvrecon.data.scenes.sample import Rays, Sample, Scene
from mvrecon.geometry.cameras.camera import Cameras
from mvrecon.geometry.grid import Grid
from mvrecon.methods.classical.sirt import sirt
from mvrecon.operators.drr import Drr

#: Random series of the scan's noise, separate from those of the patients.
SCAN = 0x63745F73


class SpectCt(Scene):
    """Cases of another scene, with attenuation in 1/mm measured by a simulated transmission scan.

    Projects the case's attenuation at 70 keV from voxels of half the size, adds Poisson noise,
    reconstructs with SIRT with momentum, and converts Hounsfield units to attenuation at 140.5 keV
    by the bilinear model of `mvrecon.data.attenuation`, at most that of cortical bone. The emission
    views use the scene's true attenuation.

    Args:
        scene: name and options of a scene with attenuation: cardiac, nema, spect_labels.
        camera: name and options of the X-ray rig.
        photons: number per pixel in air.
        iterations: iterations of SIRT.

    Raises:
        LookupError, TypeError: an unknown scene or camera, or an unknown option of it.
        ValueError: a scene without attenuation, or non-positive photons or iterations.
    """

    def __init__(
        self, scene: ScenePart, camera: CameraPart, photons: float = 1e4, iterations: int = 20
    ):
        made: Scene = SCENES.from_config(scene)
        if "mu" not in made.map_names:
            raise ValueError(
                f"Expected a scene with matter, such as cardiac, nema or spect_labels, got "
                f"{scene['name']!r}"
            )
        if iterations < 1:
            raise ValueError(f"Expected 1 iteration or more, got {iterations}")
        self.scene, self.map_names = made, made.map_names
        self.data_range, self.unit, self.length = made.data_range, made.unit, made.length
        self.cameras: Cameras = CAMERAS.from_config(camera)
        self.detector, self.iterations = Acquisition(photons=photons), iterations
        self._operators: tuple[Grid, Drr, Drr] | None = None

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_operators": None}

    def sample(self, index: int, seed: int, grid: Grid, cameras: Rays) -> Sample:
        """Case `index` of the series `seed`, with its scan."""
        return self._scanned(self.scene.sample(index, seed, grid, cameras), index, seed, grid)

    def maps(
        self, index: int, seed: int, grid: Grid, factor: int = 1
    ) -> Mapping[str, Float[Tensor, "1 d h w"]]:
        """The true linear attenuation of a case in 1/mm on `grid.refined(factor)`."""
        return self.scene.maps(index, seed, grid, factor)

    def finer(
        self, index: int, seed: int, grid: Grid, cameras: Rays, factor: int
    ) -> Float[Tensor, "1 d h w"]:
        """The case's values on `grid.refined(factor)`."""
        return self.scene.finer(index, seed, grid, cameras, factor)

    def pooled(
        self, index: int, seed: int, grid: Grid, cameras: Any, fine: Float[Tensor, "1 d h w"]
    ) -> Sample:
        """The case without views, with its truth averaged from a finer grid, and its scan."""
        return self._scanned(self.scene.pooled(index, seed, grid, cameras, fine), index, seed, grid)

    def _scanned(self, sample: Sample, index: int, seed: int, grid: Grid) -> Sample:
        scan = {"mu_measured": self.measured(index, seed, grid)}
        return replace(sample, maps={**sample.maps, **scan})

    @torch.no_grad()
    def measured(self, index: int, seed: int, grid: Grid) -> Float[Tensor, "1 d h w"]:
        """Measured linear attenuation of a case at 140.5 keV in 1/mm."""
        fine, coarse = self._on(grid)
        mu = self.scene.maps(index, seed, grid, 2)["mu"]
        at_70 = at_energy(mu, SPECT_KEV, CT_KEV)
        noise = generator(SCAN, mixed(seed, index))
        views = detected(fine(at_70[None])[0], self.detector, self.cameras, noise)
        scanned = sirt(coarse, views[None], self.iterations, momentum=True)[0]
        known = at_energy(scanned, CT_KEV, SPECT_KEV)
        return known.clamp(max=tissue_at(SPECT_KEV).bone)

    def _on(self, grid: Grid) -> tuple[Drr, Drr]:
        """The scan's operators on the finer grid and on the grid."""
        if self._operators is None or self._operators[0] is not grid:
            pair = Drr(grid.refined(2), self.cameras), Drr(grid, self.cameras)
            self._operators = (grid, *pair)
        return self._operators[1], self._operators[2]


def at_energy(
    mu: Float[Tensor, "*n"], measured_kev: float, energy_kev: float
) -> Float[Tensor, "*n"]:
    """Convert linear attenuation in 1/mm between two energies in keV by way of Hounsfield units.

    Raises:
        ValueError: an energy without tabulated values.
    """
    return attenuation(hounsfield(mu, measured_kev), energy_kev)
