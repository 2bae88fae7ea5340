"""Quantities that a network needs of an operator, computed once for each operator.

Networks hold no geometry: they are called with an operator, and what they need of it is kept beside
the operator as long as that lives.
"""

from collections.abc import Callable, Hashable, Mapping
from dataclasses import dataclass
from typing import Any
from weakref import WeakKeyDictionary

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from mvrecon.core.numbers import divided
from mvrecon.kernels.device_cache import writes
from mvrecon.methods.classical.sirt import SirtWeights, inverse_sums, sirt_weights
from mvrecon.operators.operator import (
    LinearOperator,
    Projector,
    check_finite,
    check_floating,
    check_measured,
)
from mvrecon.operators.visual_hull.support import support_masks

#: A chord counts as at least this part of the longest.
SHORTEST = 0.1

_kept: WeakKeyDictionary[LinearOperator, dict[Hashable, Any]] = WeakKeyDictionary()


def kept(A: LinearOperator, key: Hashable, make: Callable[[], Any]) -> Any:
    """The result of `make`, computed once for each operator and key.

    It is computed anew after the operator has moved to another device or one of its tensors has
    been written to, and at every call where the cameras require a gradient.

    Args:
        A: the operator. The result must not refer to it, or neither would ever be freed.
        key: names the result among those of the operator.
        make: computes it.
    """
    if A.pose_gradient or torch.compiler.is_dynamo_compiling():
        return make()
    results = _kept.setdefault(A, {})
    # how often the tensors of the operator and of its cameras have been written to
    tensors = [*A.parameters(), *A.buffers()] if isinstance(A, nn.Module) else []
    written = [tensor._version for tensor in tensors if not tensor.is_inference()]
    written += writes(A.cameras) if isinstance(A, Projector) else []
    state = key, A.device, *written
    if results.get(key, (None, None))[0] != state:
        with torch.inference_mode(False), torch.no_grad():  # training may use it after evaluation
            results[key] = state, make()
    return results[key][1]


@dataclass(frozen=True, eq=False)
class Geometry:
    """An operator with the weights of SIRT and the support of each sample.

    Args:
        A: the operator.
        row: R, the inverse row sums of A, in 1/mm. A chord counts as at least `SHORTEST` of the
            longest: where views are wrong, rays that graze the region measure more than their
            chords explain.
        column: C, the inverse column sums of A, zero outside the support.
        sums: the row sums of A, in mm, also of short chords.
        support: voxels whose density may differ from zero; None: all.
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
        """The geometry of an operator; with a support, that of A diag(support) for each sample."""
        row, column = kept(A, ("sirt weights", dtype), lambda: sirt_weights(A, dtype))
        if support is not None:
            with torch.no_grad():
                row, column = inverse_sums(A(support.to(dtype))), column * support
        longest = torch.where(row > 0, row, torch.inf).amin((1, 2, 3, 4), keepdim=True)
        return cls(A, row.minimum(longest / SHORTEST), column, divided(1.0, row), support)

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

    def within(self, volume: Float[Tensor, "b c d h w"]) -> Float[Tensor, "b c d h w"]:
        """Volumes, zero outside the support."""
        return volume if self.support is None else volume * self.support


def geometry_of(
    views: Float[Tensor, "b 1 m v u"],
    A: Projector,
    support: str = "none",
    noise: Mapping[str, Any] | None = None,
) -> Geometry:
    """The geometry of an operator, in the dtype of the views, with the support of each sample.

    Args:
        views: as `validated` returns them.
        A: the operator.
        support: by the views: the visual "hull", its "box", "auto" or "none".
        noise: of the views, as of `support_from_views`.
    """
    if support == "none":
        return Geometry.of(A, views.dtype)
    return Geometry.of(A, views.dtype, support_masks(views, A.cameras, A.grid, support, noise))


def validated(views: Tensor, A: Projector, weights: Tensor) -> Float[Tensor, "b 1 m v u"]:
    """Measured views in the dtype of a network's weights, which is that of the volume, too.

    Raises:
        ValueError: a wrong rank, size or device, more than one channel, no sample, values that are
            no floating point or, on the CPU, not finite; weights of half precision, which the
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
