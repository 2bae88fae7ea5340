"""The 3-D Shepp-Logan head phantom."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch

from mvrecon.data.scenes.analytic import AnalyticScene
from mvrecon.data.scenes.solids import Phantom, Solids
from mvrecon.geometry.grid import Grid
from mvrecon.geometry.rigid import euler_rotation

#: Yu, Ye and Wang, "Katsevich-type algorithms for variable radius spiral cone-beam CT", Proc. SPIE
#: 5535 (2004) 550: the head of Kak and Slaney, Principles of Computerized Tomographic Imaging
#: (1988), table 3.1, in 3-D, with contrasts that the eye can see. Columns: value, semi-axes a b c,
#: centre x y z, turn about z in degrees; the head is in [-1, 1].
TABLE = (
    (1.0, 0.69, 0.92, 0.9, 0.0, 0.0, 0.0, 0.0),
    (-0.8, 0.6624, 0.874, 0.88, 0.0, 0.0, 0.0, 0.0),
    (-0.2, 0.41, 0.16, 0.21, -0.22, 0.0, -0.25, 108.0),
    (-0.2, 0.31, 0.11, 0.22, 0.22, 0.0, -0.25, 72.0),
    (0.2, 0.21, 0.25, 0.5, 0.0, 0.35, -0.25, 0.0),
    (0.2, 0.046, 0.046, 0.046, 0.0, 0.1, -0.25, 0.0),
    (0.1, 0.046, 0.023, 0.02, -0.08, -0.65, -0.25, 0.0),
    (0.1, 0.046, 0.023, 0.02, 0.06, -0.65, -0.25, 90.0),
    (0.2, 0.056, 0.04, 0.1, 0.06, -0.105, 0.625, 90.0),
    (-0.2, 0.056, 0.056, 0.1, 0.0, 0.1, 0.625, 0.0),
)


def shepp_logan(
    half_edge: float = 1.0, centre: Sequence[float] = (0.0, 0.0, 0.0), value: float = 1.0
) -> Phantom:
    """The 3-D Shepp-Logan phantom in the cube of a half edge in mm about a centre; the skull has
    the value given.

    Raises:
        ValueError: a half edge that is not positive.
    """
    table = torch.tensor(TABLE, dtype=torch.float64)
    turns = torch.nn.functional.pad(table[:, 7:], (0, 2))
    semi_axes, places = table[:, 1:4] * half_edge, table[:, 4:7] * half_edge
    places = places + torch.tensor(list(centre), dtype=torch.float64)
    return Phantom(
        (Solids("ellipsoid", places, euler_rotation(turns), semi_axes, table[:, 0] * value),)
    )


@dataclass(frozen=True, kw_only=True)
class SheppLogan(AnalyticScene):
    """One case: the 3-D Shepp-Logan phantom, whose cube [-1, 1] has the field's radius as its half
    edge.
    """

    field: float = 0.5
    kind = "shepp_logan"
    length = 1

    def phantom(self, rng: torch.Generator, grid: Grid) -> Phantom:
        """The phantom in the field of `grid`; nothing of it is random."""
        return shepp_logan(self.radius(grid), grid.centre.tolist(), self.value)
