"""The data term of the penalised methods, one for all, so that a weight means the same in them."""

from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from mvrecon.core.numbers import divided, positive_mean
from mvrecon.methods.classical.iterative import SirtWeights, sirt_weights
from mvrecon.operators.operator import LinearOperator


class WeightedFit(NamedTuple):
    """The data term |y - A x|^2_R / (2 c), in the square of the unit of the volume, summed over
    voxels.

    R are the inverse row sums of A, as in SIRT, and c is the mean column sum of the voxels that a
    ray meets. For a change of all voxels alike it is half the square of that change, summed over
    voxels, and the less the finer a change is; whatever the number of views, pixels and voxels, so
    that a penalty's weight means the same on every rig.

    Args:
        weights: R and C of `sirt_weights`.
        level: c, rays through a voxel times their length in it, in mm.
    """

    weights: SirtWeights
    level: float

    @classmethod
    def of(cls, A: LinearOperator, dtype: torch.dtype) -> "WeightedFit":
        """The data term of an operator."""
        weights = sirt_weights(A, dtype)
        return cls(weights, positive_mean(divided(1.0, weights.column), 1.0))

    @property
    def columns(self) -> Float[Tensor, "1 1 d h w"]:
        """The column sums of A, in mm."""
        return divided(1.0, self.weights.column)

    def __call__(self, residual: Float[Tensor, "b c m v u"]) -> Float[Tensor, "b c"]:
        """The data term of residual views."""
        squares = self.weights.row * residual.square()
        return squares.flatten(2).sum(dim=2) / (2 * self.level)
