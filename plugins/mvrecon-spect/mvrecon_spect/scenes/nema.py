"""Hot spheres in a warm body, after the image quality phantom of NEMA NU 2: a test of contrast
recovery against background variability.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from mvrecon.core.quantities import PositiveFloat
from mvrecon.data.scenes.solids import Phantom, Solids
from mvrecon.geometry.grid import Grid
from mvrecon_spect.scenes.attenuating import AttenuatingScene
from mvrecon_spect.scenes.defrise import OneCase

#: Diameters of the six spheres in mm, and the radius of the circle that their centres lie on.
DIAMETERS, CIRCLE = (10.0, 13.0, 17.0, 22.0, 28.0, 37.0), 57.2


def nema(
    body: Sequence[float] = (100.0, 90.0, 60.0),
    diameters: Sequence[float] = DIAMETERS,
    circle: float = CIRCLE,
    contrast: float = 4.0,
    centre: Sequence[float] = (0.0, 0.0, 0.0),
    value: float = 1.0,
) -> Phantom:
    """Spheres at equal angles on a circle in a plane across z, in an elliptic cylinder along z.

    Args:
        body: semi-axes (x, y) of the cylinder and half of its height, in mm.
        diameters: diameters of the spheres in mm, counter-clockwise viewed from +z, the first at
            +x.
        circle: radius in mm of the circle of their centres.
        contrast: ratio of the spheres' value to the body's; inf: an empty body.
        centre: centre in world mm.
        value: value in the spheres.

    Raises:
        ValueError: non-positive sizes, a contrast of 1 or less, or spheres that overlap or extend
            outside the body.
    """
    if len(body) != 3 or not min(*body, *diameters, circle) > 0 or not contrast > 1:
        raise ValueError(
            f"Expected three positive semi-axes of the body, positive diameters and circle in mm, "
            f"and a contrast above 1, got {list(body)}, {list(diameters)}, {circle} and {contrast}"
        )
    places, radii = _ring(len(diameters), circle), torch.tensor(list(diameters)).double() / 2
    apart = torch.cdist(places, places) - radii - radii[:, None]
    reach = (places[:, :2].norm(dim=1) + radii).max().item()
    if apart[~torch.eye(len(radii), dtype=torch.bool)].min() < 0 or reach > min(body[:2]):
        raise ValueError(
            f"Expected spheres that do not overlap, in the body, got diameters {list(diameters)} "
            f"on a circle of {circle} mm in {list(body)}"
        )
    middle = torch.tensor(list(centre), dtype=torch.float64)
    sizes, warm = radii[:, None].expand(-1, 3), value / contrast
    hot = torch.full_like(radii, value - warm)
    spheres = Solids("ellipsoid", places + middle, _upright(len(radii)), sizes, hot)
    return Phantom((_cylinder(body, middle, warm), spheres))


def _ring(count: int, radius: float) -> Float[Tensor, "n 3"]:
    angles = 2 * torch.pi * torch.arange(count, dtype=torch.float64) / count
    return radius * torch.stack([angles.cos(), angles.sin(), torch.zeros_like(angles)], dim=-1)


def _upright(count: int) -> Float[Tensor, "n 3 3"]:
    return torch.eye(3, dtype=torch.float64).expand(count, 3, 3)


def _cylinder(body: Sequence[float], centre: Float[Tensor, "3"], value: float) -> Solids:
    sizes = torch.tensor([list(body)], dtype=torch.float64)
    return Solids("cylinder", centre[None], _upright(1), sizes, sizes.new_tensor([value]))


@dataclass(frozen=True, kw_only=True)
class Nema(OneCase, AttenuatingScene):
    """One case: hot spheres in a warm body of water, centred on the grid.

    Args:
        body_mm: semi-axes (x, y) of the body, an elliptic cylinder along z, and half of its height.
        diameters: diameters of the spheres in mm.
        circle_mm: radius of the circle of their centres.
        contrast: ratio of the spheres' value to the body's.
        mu: attenuation of the body in 1/mm; water at 140.5 keV by default, 0: none.

    Raises:
        ValueError: see `nema`.
    """

    body_mm: tuple[float, float, float] = (100.0, 90.0, 60.0)
    diameters: tuple[PositiveFloat, ...] = DIAMETERS
    circle_mm: float = CIRCLE
    contrast: float = 4.0
    mu: float = 0.01536
    kind = "nema"

    def about(self, centre: Sequence[float]) -> Phantom:
        """The spheres in their body, centred at a point in world mm."""
        spheres = self.diameters, self.circle_mm, self.contrast
        return nema(self.body_mm, *spheres, centre, self.value)

    def matter(self, rng: torch.Generator, grid: Grid) -> Phantom:
        """The body's attenuation in 1/mm."""
        return Phantom((_cylinder(self.body_mm, grid.centre, self.mu),))
