"""The Defrise phantom: equal discs along the axis, whose gaps no camera views edge-on."""

from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass

import torch

from mvrecon.core.quantities import PositiveFloat, PositiveInt
from mvrecon.data.scenes.analytic import AnalyticScene
from mvrecon.data.scenes.solids import Phantom, Solids
from mvrecon.geometry.grid import Grid


@dataclass(frozen=True, kw_only=True)
class OneCase(AnalyticScene):
    """A deterministic scene of one case, centred on the grid."""

    field: PositiveFloat = 0.5
    unit: str = "activity"
    length = 1

    def __post_init__(self) -> None:
        super().__post_init__()
        self.about((0.0, 0.0, 0.0))  # raises for inconsistent sizes

    @abstractmethod
    def about(self, centre: Sequence[float]) -> Phantom:
        """The phantom centred at a point in world mm."""

    def phantom(self, rng: torch.Generator, grid: Grid) -> Phantom:
        """The phantom centred on `grid`."""
        return self.about(grid.centre.tolist())


@dataclass(frozen=True, kw_only=True)
class Defrise(OneCase):
    """One case: a stack of equal discs along z, centred on the grid, a test of cone-beam and
    pinhole artefacts along the axis.

    Kudo and Saito, J. Opt. Soc. Am. A 7 (1990) 2169, and Defrise and Clack, IEEE Trans. Med.
    Imaging 13 (1994) 186: circular orbits do not determine planes that no camera views edge-on.

    Args:
        discs: number of discs.
        radius_mm: radius of the discs.
        thickness_mm: thickness of the discs.
        pitch_mm: distance between adjacent discs, at least the thickness.

    Raises:
        ValueError: no discs, sizes that are not positive, or discs that overlap.
    """

    discs: PositiveInt = 7
    radius_mm: PositiveFloat = 60.0
    thickness_mm: PositiveFloat = 8.0
    pitch_mm: PositiveFloat = 16.0
    kind = "defrise"

    def about(self, centre: Sequence[float]) -> Phantom:
        """The stack of discs centred at a point in world mm."""
        discs, radius = self.discs, self.radius_mm
        thickness, pitch = self.thickness_mm, self.pitch_mm
        if not (discs >= 1 and radius > 0 and 0 < thickness <= pitch):
            raise ValueError(
                f"Expected one disc or more, of positive radius and thickness, at a pitch of at "
                f"least the thickness, got {discs} discs, {radius}, {thickness} and {pitch} mm"
            )
        places = torch.tensor([list(centre)], dtype=torch.float64).repeat(discs, 1)
        places[:, 2] += (torch.arange(discs) - (discs - 1) / 2) * pitch
        sizes = places.new_tensor([radius, radius, thickness / 2]).expand(discs, 3)
        values = places.new_full((discs,), self.value)
        return Phantom((Solids.upright("cylinder", places, sizes, values),))
