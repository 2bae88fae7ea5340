"""How far a volume can be above the minimum of total variation regularisation, by duality."""

from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from mvrecon.reconstructors.division import divided
from mvrecon.reconstructors.problem import Iterate, Monitor
from mvrecon.reconstructors.total_variation import gradient, gradient_adjoint
from mvrecon.reconstructors.weighted_fit import WeightedFit

#: The minimum is sought among values up to so many times the largest of the volume.
REACH = 2.0


class Bound(NamedTuple):
    """A linear function below the data term and the total variation, c times as large.

    Args:
        views: q, a multiplier of the residual views.
        back: A^T q.
        field: p, without unit, vectors of length 1 at most; None without total variation.
    """

    views: Float[Tensor, "b c m v u"]
    back: Float[Tensor, "b c d h w"]
    field: Float[Tensor, "3 b c d h w"] | None


class PenalisedFit(NamedTuple):
    """What is minimised, |y - A x|^2_R / (2 c) + weight sum |D x|, in the square of the unit of the
    volume.

    Args:
        fit: the data term.
        weight: of the total variation, in (unit of the volume) mm.
        steps: voxel size along (z, y, x), in mm.
        nonnegative: only volumes without negative values.
        support: 1 where voxels may be anything but zero; None: everywhere.
    """

    fit: WeightedFit
    weight: float
    steps: tuple[float, float, float]
    nonnegative: bool
    support: Float[Tensor, "d h w"] | None

    def gap(
        self,
        volume: Float[Tensor, "b c d h w"],
        residual: Float[Tensor, "b c m v u"],
        bound: Bound,
    ) -> Float[Tensor, "b c"]:
        """How far the objective is above its minimum at most, relative to the objective.

        The duality gap over volumes of values up to twice the largest one, as a sum of terms of
        which none is negative, so that rounding hides nothing (Chambolle and Pock, J. Math. Imaging
        Vis. 40, 2011, eq. 9, restricted as in their section 3.1). Zero where the objective is.

        Args:
            volume: x.
            residual: y - A x.
            bound: of the method's dual steps.
        """
        row, level = self.fit.weights.row, self.fit.level
        misfit = torch.where(row > 0, residual - bound.views / torch.where(row > 0, row, 1), 0)
        terms, slope = [_sum(row * misfit.square()) / (2 * level)], -bound.back / level
        value = _sum(row * residual.square()) / (2 * level)
        if bound.field is not None:
            change = gradient(volume, self.steps)
            size = torch.linalg.vector_norm(change, dim=0)
            value = value + self.weight * _sum(size)
            terms.append(self.weight * _sum(size - (bound.field * change).sum(dim=0)))
            slope = slope + self.weight * gradient_adjoint(bound.field, self.steps)
        if self.support is not None:
            slope = slope * self.support
        reach = REACH * volume.abs().flatten(2).amax(dim=2)[..., None, None, None]
        lowest = torch.zeros_like(reach) if self.nonnegative else -reach
        terms.append(_sum(slope * (volume - torch.where(slope > 0, lowest, reach))))
        total = torch.stack(terms).sum(dim=0)
        return divided(total, value)


def closed(gap: float) -> Monitor:
    """A monitor that ends each sample whose duality gap is at most so much of its objective.

    Args:
        gap: such as 1e-3.
    """

    def small(iterate: Iterate) -> Tensor | bool:
        return False if iterate.gap is None else (iterate.gap <= gap).all(dim=1)

    return small


def _sum(values: Float[Tensor, "b c *n"]) -> Float[Tensor, "b c"]:
    return values.flatten(2).sum(dim=2, dtype=torch.float64)
