"""Random ellipsoids: one large body that holds smaller ones of higher and of lower value."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from mvrecon.core.numbers import uniform
from mvrecon.core.quantities import PositiveFloat
from mvrecon.data.scenes.analytic import AnalyticScene
from mvrecon.data.scenes.solids import Phantom, Solids
from mvrecon.geometry.grid import Grid
from mvrecon.geometry.rigid import random_in_ball, random_rotation


@dataclass(frozen=True, kw_only=True)
class RandomEllipsoids(AnalyticScene):
    """Cases of a random body with random ellipsoids in it; every value lies between 0 and `value`.

    Args:
        count: least and greatest number of ellipsoids in the body.
        sizes: least and greatest semi-axis of those, as fractions of the field's radius.

    Raises:
        ValueError: counts or sizes that are negative or not ascending.
    """

    count: tuple[int, int] = (3, 12)
    sizes: tuple[PositiveFloat, PositiveFloat] = (0.1, 0.45)
    kind = "ellipsoids"

    def __post_init__(self) -> None:
        super().__post_init__()
        if len(self.count) != 2 or not 0 <= self.count[0] <= self.count[1]:
            raise ValueError(
                f"Ellipsoids need a count (least, greatest) of at least 0, got {tuple(self.count)}"
            )
        if len(self.sizes) != 2 or not 0 < self.sizes[0] <= self.sizes[1]:
            raise ValueError(
                f"Ellipsoids need sizes (least, greatest) above 0, got {tuple(self.sizes)}"
            )

    def phantom(self, rng: torch.Generator, grid: Grid) -> Phantom:
        """A random phantom in the field of `grid`; the body comes first, and holds all the
        others.
        """
        radius = self.radius(grid)
        body_axes = torch.tensor(
            [uniform(rng, 0.6, 0.95) * radius for _ in range(3)], dtype=torch.float64
        )
        body_centre = grid.centre + random_in_ball(rng, radius - body_axes.max().item())
        body_rotation = random_rotation(rng)
        count = int(torch.randint(self.count[0], self.count[1] + 1, (), generator=rng))
        places = torch.stack([body_centre] + [torch.zeros(3).to(body_centre)] * count)
        axes = torch.stack([body_axes] * (count + 1))
        for n in range(1, count + 1):
            p = random_in_ball(rng, 0.85)
            room = (1 - p.norm().item()) * body_axes.min().item()  # what surely fits into the body
            places[n] = body_centre + body_rotation @ (body_axes * p)
            for i in range(3):
                axes[n, i] = min(room, uniform(rng, *self.sizes) * radius)
        rotations = torch.cat([body_rotation[None], random_rotation(rng, count)])
        return Phantom(
            (Solids("ellipsoid", places, rotations, axes, self.value * _values(rng, places, axes)),)
        )


def _values(
    rng: torch.Generator, places: Float[Tensor, "n 3"], axes: Float[Tensor, "n 3"]
) -> Float[Tensor, " n"]:
    """Random values, the first positive, whose sums over overlapping ellipsoids stay between 0 and
    1.

    Of each ellipsoid it is known which earlier ones may overlap it (their bounding spheres do). Its
    value takes a part of the room that all of those together leave, so the sum is bounded at every
    point.
    """
    reach = axes.amax(dim=1)
    meet = torch.cdist(places, places) < reach + reach[:, None]
    meet[0], meet[:, 0] = True, True
    values = torch.zeros(len(places), dtype=torch.float64)
    values[0] = uniform(rng, 0.2, 0.4)
    for n in range(1, len(values)):
        earlier = values[:n][meet[n, :n]]
        # neighbours of n that do not meet each other may leave no room together
        below = (earlier[0] + earlier.clamp(max=0).sum()).clamp(min=0)
        above = (1 - earlier.clamp(min=0).sum()).clamp(min=0)
        up = uniform(rng, 0, 1) < 0.6
        values[n] = uniform(rng, 0.3, 1.0) * above if up else -uniform(rng, 0.3, 0.9) * below
    return values
