"""Resolved rods of a Derenzo phantom, by the valley-to-peak ratio of neighbours."""

from collections.abc import Sequence
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from mvrecon.core.numbers import divided
from mvrecon.data.scenes.phantoms import sector_wells
from mvrecon.geometry.grid import Grid
from mvrecon.geometry.lattice import normalised, sample
from mvrecon.geometry.rigid import euler_rotation

#: Two rods are resolved up to this ratio, as by Rayleigh's criterion for two points.
RESOLVED = 0.735
#: Heights along the rods over which profiles are averaged.
HEIGHTS = 16


class Sector(NamedTuple):
    """Result for the rods of one diameter.

    Args:
        diameter: diameter of the rods, in mm.
        ratios: valley-to-peak ratio of each pair of neighbours; infinite without a peak; empty for
            a single rod.
    """

    diameter: float
    ratios: Float[Tensor, " p"]

    @property
    def resolved(self) -> float:
        """Fraction of resolved pairs; nan without a pair."""
        return (self.ratios <= RESOLVED).double().mean().item()


def valley_to_peak(
    volume: Float[Tensor, "d h w"],
    grid: Grid,
    well_diameters: Sequence[float] = (8, 6, 5, 4, 3, 2),
    radius: float = 40.0,
    height: float = 80.0,
    centre: Sequence[float] = (0.0, 0.0, 0.0),
    euler_degrees: Sequence[float] = (0.0, 0.0, 0.0),
) -> list[Sector]:
    """Valley-to-peak ratio of all neighbouring rods of each sector, dimensionless: the value at
    the midpoint divided by the mean of the values at both centres.

    Values are interpolated trilinearly and averaged over the central half of the rods' height. A
    pair is resolved up to 0.735 (Hallen, Schug, Weissler, Gebhardt, Salomon, Kiessling, Schulz,
    EJNMMI Phys. 7 (2020) 12).

    Args:
        volume: activity.
        grid: grid of the volume.
        well_diameters, radius, height, centre, euler_degrees: parameters of the phantom, see
            `derenzo`.

    Raises:
        ValueError: the shape of the volume is not that of the grid, or rods are outside the grid.
    """
    if tuple(volume.shape) != grid.shape:
        raise ValueError(f"Expected a volume of shape {grid.shape}, got {tuple(volume.shape)}")
    turns = euler_rotation([(60.0 * k, 0.0, 0.0) for k in range(len(well_diameters))])
    to_world, origin = euler_rotation(euler_degrees), torch.tensor(list(centre)).double()
    sectors = []
    for diameter, turn in zip(well_diameters, turns, strict=True):
        wells = sector_wells(diameter, radius)
        one, other = _neighbours(wells, diameter)
        places = torch.stack([one, (one + other) / 2, other], dim=1) @ turn[:2, :2].T
        along = torch.linspace(-height / 4, height / 4, HEIGHTS, dtype=torch.float64)
        points = torch.cat(
            [
                places[:, :, None].expand(-1, -1, HEIGHTS, -1),
                along[:, None].expand(len(places), 3, HEIGHTS, 1),
            ],
            dim=-1,
        )
        left, valley, right = _means(volume, grid, points @ to_world.T + origin).unbind(dim=1)
        peak = (left + right) / 2
        ratios = divided(valley, peak, torch.inf)
        sectors.append(Sector(float(diameter), ratios))
    return sectors


def _neighbours(
    wells: Float[Tensor, "n 2"], diameter: float
) -> tuple[Float[Tensor, "p 2"], Float[Tensor, "p 2"]]:
    """Both rods of all pairs at a distance of twice the diameter."""
    near = (torch.cdist(wells, wells) < 2.01 * diameter).triu(diagonal=1)
    one, other = near.nonzero().unbind(dim=1)
    return wells[one], wells[other]


def _means(
    volume: Float[Tensor, "d h w"], grid: Grid, points: Float[Tensor, "p k n 3"]
) -> Float[Tensor, "p k"]:
    index = grid.to_index(points)
    if not ((index > -0.5) & (index < torch.tensor(grid.size) - 0.5)).all():
        raise ValueError("Expected a Derenzo phantom inside the grid, got wells outside")
    values = sample(volume.double()[None, None], normalised(index, grid.shape)[None])
    return values[0, 0].mean(dim=-1)
