"""Hot spheres in a warm body, after the image quality phantom of NEMA NU 2: a test of contrast
recovery against background variability.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import torch

from mvrecon.core.quantities import PositiveFloat
from mvrecon.data.scenes.solids import Phantom, Solids
from mvrecon.geometry.grid import Grid
from mvrecon_spect.scenes.attenuating import AttenuatingScene
from mvrecon_spect.scenes.defrise import OneCase

#: Diameters of the six spheres in mm, and the radius of the circle that their centres lie on.
DIAMETERS, CIRCLE = (10.0, 13.0, 17.0, 22.0, 28.0, 37.0), 57.2


@dataclass(frozen=True, kw_only=True)
class Nema(OneCase, AttenuatingScene):
    """One case: hot spheres at equal angles on a circle across z, in a warm body of water, centred
    on the grid.

    Args:
        body_mm: semi-axes (x, y) of the body, an elliptic cylinder along z, and half of its height.
        diameters: diameters of the spheres in mm, counter-clockwise viewed from +z, the first at
            +x.
        circle_mm: radius of the circle of their centres.
        contrast: ratio of the spheres' value to the body's; inf: an empty body.
        mu: attenuation of the body in 1/mm; water at 140.5 keV by default, 0: none.

    Raises:
        ValueError: sizes that are not positive, a contrast of 1 or less, or spheres that overlap or
            extend outside the body.
    """

    body_mm: tuple[float, float, float] = (100.0, 90.0, 60.0)
    diameters: tuple[PositiveFloat, ...] = DIAMETERS
    circle_mm: float = CIRCLE
    contrast: float = 4.0
    mu: float = 0.01536
    kind = "nema"

    def about(self, centre: Sequence[float]) -> Phantom:
        """The spheres in their body, centred at a point in world mm."""
        body, diameters, circle = list(self.body_mm), list(self.diameters), self.circle_mm
        if len(body) != 3 or not min(*body, *diameters, circle) > 0 or not self.contrast > 1:
            raise ValueError(
                f"Expected three positive semi-axes of the body, positive diameters and circle in "
                f"mm, and a contrast above 1, got {body}, {diameters}, {circle} and {self.contrast}"
            )
        radii = torch.tensor(diameters, dtype=torch.float64) / 2
        angles = 2 * torch.pi * torch.arange(len(radii), dtype=torch.float64) / len(radii)
        places = circle * torch.stack([angles.cos(), angles.sin(), torch.zeros_like(angles)], dim=1)
        apart = (torch.cdist(places, places) - radii - radii[:, None]).fill_diagonal_(torch.inf)
        reach = (circle + radii).max().item()
        if apart.min() < 0 or reach > min(body[:2]):
            raise ValueError(
                f"Expected spheres that do not overlap, in the body, got diameters {diameters} on "
                f"a circle of {circle} mm in {body}"
            )
        middle = torch.tensor(list(centre), dtype=torch.float64)
        warm = self.value / self.contrast
        hot, sizes = torch.full_like(radii, self.value - warm), radii[:, None].expand(-1, 3)
        spheres = Solids.upright("ellipsoid", places + middle, sizes, hot)
        return Phantom((self._body(middle, warm), spheres))

    def matter(self, rng: torch.Generator, grid: Grid) -> Phantom:
        """The body's attenuation in 1/mm."""
        return Phantom((self._body(grid.centre, self.mu),))

    def _body(self, centre: torch.Tensor, value: float) -> Solids:
        sizes = torch.tensor([list(self.body_mm)], dtype=torch.float64)
        return Solids.upright("cylinder", centre[None], sizes, sizes.new_tensor([value]))
