"""The lines through a grid's inscribed cylinder that no ray of a scan measures."""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from mvrecon.methods.classical.orbit import Orbit
from mvrecon.methods.classical.steps import FULL_TURN


@dataclass(frozen=True, eq=False)
class Missing:
    """The lines through a grid's inscribed cylinder that no ray measures.

    Args:
        share: their share of all lines through it.
        worst: greatest share of the lines at one distance from the axis of which some are measured.
        where: where they are, in words.
        hole: whether no line at some distance from the axis is measured, but lines farther off are.
        radius: radius of the cylinder, in mm.
    """

    share: float
    worst: float
    hole: bool
    where: str
    radius: float

    def __str__(self) -> str:
        return (
            f"{self.share:.1%} of the lines through the grid's inscribed cylinder, up to its "
            f"outermost voxels' centres at {self.radius:.4g} mm, are not measured: {self.where}"
        )

    @classmethod
    def of(
        cls,
        measured: Bool[Tensor, "q n"],
        q: Float[Tensor, " q"],
        orbit: Orbit,
        start: float,
        radius: float,
        offset: Float[Tensor, "3"],
    ) -> "Missing":
        """Lines of all branches, by their density in angle and distance.

        Args:
            measured: whether each of them is.
            q: fan coordinates of the branches, symmetric about zero.
            start: where the raster of angles starts, in radians after the first view.
            radius: radius of the cylinder, in mm.
            offset: vector from the isocentre to the cylinder, in mm.
        """
        count = measured.shape[1]
        q, measured = q[len(q) // 2 :], measured[len(q) // 2 :]
        if orbit.radius == math.inf:
            s, turn, density = q, torch.zeros_like(q), torch.ones_like(q)
        else:
            s, turn, density = orbit.radius * q.sin(), q, q.cos()
        # direction of the line's normal, in the orbit's plane, from the first view's tangent
        beta = start + (torch.arange(count, dtype=torch.float64) + 0.5) * (FULL_TURN / count)
        theta = beta - turn[:, None]
        tangent = torch.linalg.cross(orbit.axis, orbit.outwards[0])
        x, y = offset @ orbit.outwards[0], offset @ tangent
        # a line that is tangent to the cylinder has no length in it
        through = (s[:, None] - (theta.cos() * y - theta.sin() * x)).abs() < radius * (1 - 1e-6)
        lines = through * density[:, None]
        lines[0] *= 0.5  # its other half is the conjugate branch
        gone = ~measured & through
        share = ((gone * lines).sum() / lines.sum().clamp_min(1e-300)).item()
        everywhere = (gone == through).all(dim=1) & through.any(dim=1)
        some = gone.any(dim=1) & ~everywhere
        seen = (through & ~gone).any(dim=1)
        hole = bool((everywhere & (seen.flip(0).cumsum(0).flip(0) > 0)).any())
        worst = (gone.double().mean(dim=1) * ~everywhere).max().item()
        return cls(share, worst, hole, _where(everywhere, some, gone, s, theta), radius)


def _where(
    everywhere: Bool[Tensor, " q"],
    some: Bool[Tensor, " q"],
    gone: Bool[Tensor, "q n"],
    s: Float[Tensor, " q"],
    theta: Float[Tensor, "q n"],
) -> str:
    """The distances from the axis, and the angles, of lines that are not measured."""
    words = []
    if everywhere.any():
        words.append(f"all at {_range(s[everywhere])} mm from the axis of rotation")
    if some.any():
        angles = theta[some][gone[some]].rad2deg().remainder(360).round().long()
        taken = torch.zeros(360, dtype=torch.bool)
        taken[angles % 360] = True
        first = int((~taken).int().argmax())  # a run does not begin at 359 if it continues at 0
        runs = taken.roll(-first).int().diff(prepend=torch.zeros(1, dtype=torch.int32))
        begins, ends = (runs > 0).nonzero()[:, 0], (runs < 0).nonzero()[:, 0]
        sizes = torch.cat([ends, torch.tensor([360])])[: len(begins)] - begins
        best = int(sizes.argmax())
        start = (int(begins[best]) + first) % 360
        words.append(
            f"{'others' if words else 'those'} at {_range(s[some])} mm, up to "
            f"{gone[some].double().mean(dim=1).max():.1%} of those at one distance, "
            f"{'mainly ' if len(sizes) > 1 else ''}from {start} to {start + int(sizes[best])} "
            f"degrees after the first view"
        )
    return "; ".join(words)


def _range(s: Float[Tensor, " q"]) -> str:
    return f"{s.min().item():.3g} to {s.max().item():.3g}"
