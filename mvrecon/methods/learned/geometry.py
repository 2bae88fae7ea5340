"""The operator as networks use it: with SIRT's weights, computed once, and each sample's support.

Networks hold no geometry; the operator is an argument of each call.
"""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from mvrecon.core.numbers import divided
from mvrecon.methods.classical.sirt import SirtWeights, inverse_sums, sirt_weights
from mvrecon.operators.checks import check_finite, check_floating, check_measured
from mvrecon.operators.memo import kept
from mvrecon.operators.operator import Projector
from mvrecon.operators.visual_hull.support import ViewNoise, support_masks

#: Chords are clamped to at least this part of the longest.
MIN_CHORD_SHARE = 0.1


@dataclass(frozen=True, eq=False)
class Geometry:
    """An operator with the weights of SIRT and the support of each sample.

    Args:
        A: the operator.
        row: R, the inverse row sums of A, in 1/mm. Chords are clamped to at least `MIN_CHORD_SHARE`
            of the longest, as rays that graze the region may measure more than their chords
            explain.
        column: C, the inverse column sums of A, zero outside the support.
        sums: the row sums of A, in mm, not clamped.
        support: voxels that may differ from zero; None: all.
    """

    A: Projector
    row: Float[Tensor, "#b 1 m v u"]
    column: Float[Tensor, "#b 1 d h w"]
    sums: Float[Tensor, "#b 1 m v u"]
    support: Bool[Tensor, "b 1 d h w"] | None = None

    @classmethod
    def of(
        cls,
        A: Projector,
        dtype: torch.dtype = torch.float32,
        support: Bool[Tensor, "b 1 d h w"] | None = None,
    ) -> "Geometry":
        """The geometry of an operator, or with a support of A diag(support) for each sample."""
        row, column = kept(A, ("sirt weights", dtype), lambda: sirt_weights(A, dtype))
        if support is not None:
            with torch.no_grad():
                row, column = inverse_sums(A(support.to(dtype))), column * support
        longest = torch.where(row > 0, row, torch.inf).amin((1, 2, 3, 4), keepdim=True)
        return cls(A, row.minimum(longest / MIN_CHORD_SHARE), column, divided(1.0, row), support)

    @property
    def weights(self) -> SirtWeights:
        """R and C of SIRT."""
        return SirtWeights(self.row, self.column)

    def direction(
        self,
        residual: Float[Tensor, "b c m v u"],
        ray_weights: Float[Tensor, "b 1 m v u"] | float = 1.0,
    ) -> Float[Tensor, "b c d h w"]:
        """SIRT's direction C A^T R w r of residual views r, in the unit of the volume."""
        return self.column * self.A.T(self.row * ray_weights * residual)

    @torch.no_grad()
    def longest_step(self, ray_weights: Float[Tensor, "b 1 m v u"]) -> Float[Tensor, "b 1 d h w"]:
        """Greatest length l of a step x + l C A^T R w (y - A x) at each voxel that is stable for
        weighted rays, 2 / (C A^T R w A 1).

        The matrix l C A^T R w A has no negative entry and rows that sum to at most 2, so that no
        eigenvalue exceeds 2. One back-projection, without gradient.
        """
        sums = self.column * self.A.T(self.row * ray_weights * self.sums)
        return divided(2.0, sums, math.inf)

    def within(self, volume: Float[Tensor, "b c d h w"]) -> Float[Tensor, "b c d h w"]:
        """Set volumes to zero outside the support."""
        return volume if self.support is None else volume * self.support


def geometry_of(
    views: Float[Tensor, "b 1 m v u"],
    A: Projector,
    support: str = "none",
    noise: ViewNoise | None = None,
) -> Geometry:
    """Return the geometry of an operator, in the dtype of the views, with each sample's support.

    Args:
        views: the views as `validated` returns them.
        A: the operator.
        support: voxels that the views do not show to be empty: the visual "hull", its "box", "auto"
            or "none".
        noise: noise of the views, as in `support_from_views`.
    """
    if support == "none":
        return Geometry.of(A, views.dtype)
    return Geometry.of(A, views.dtype, support_masks(views, A.cameras, A.grid, support, noise))


def validated(views: Tensor, A: Projector, weights: Tensor) -> Float[Tensor, "b 1 m v u"]:
    """Convert measured views to the dtype of a network's weights.

    Raises:
        ValueError: a wrong rank, size or device, more than one channel, an empty batch, values that
            are not floating point or, on the CPU, not finite; weights of half precision, which
            operators do not support (use `torch.autocast`).
    """
    if weights.dtype not in (torch.float32, torch.float64):
        raise ValueError(
            f"Expected a network of float32 or float64, got {weights.dtype}; for half precision "
            f"use torch.autocast"
        )
    check_measured(views, "views [b 1 m v u]", (len(A.cameras), *A.cameras.shape), weights.device)
    if views.shape[1] != 1:
        raise ValueError(f"Expected views [b 1 m v u] of one channel, got {tuple(views.shape)}")
    check_floating(views, "views")
    check_finite(views, on_gpu=False)  # there `start.nonzero` makes the volume NaN
    return views.to(weights.dtype)
