"""Operators on one volume, stacked: several scanners, or several energies, that see the same
object.
"""

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor, nn

from mvrecon.operators.operator import LinearOperator


class Stacked(nn.Module, LinearOperator):
    """Operators on one domain, one above the other: their views are joined along the axis of the
    cameras.

    Raises:
        ValueError: domains or detectors that differ.
    """

    def __init__(self, parts: Sequence[LinearOperator]):
        super().__init__()
        shapes = {(A.domain_shape, A.range_shape[1:]) for A in parts}
        if len(shapes) != 1:
            raise ValueError(
                f"Stacked operators need one domain and one detector, got {sorted(shapes)}"
            )
        self.parts = list(parts)
        # registered, too, so that `.to(device)` moves those that are modules
        self.modules_of_parts = nn.ModuleList(A for A in parts if isinstance(A, nn.Module))
        self.domain_shape = parts[0].domain_shape
        self.range_shape = (sum(A.range_shape[0] for A in parts), *parts[0].range_shape[1:])

    @property
    def device(self) -> torch.device:
        return self.parts[0].device

    @property
    def pose_gradient(self) -> bool:
        return any(A.pose_gradient for A in self.parts)

    def forward(self, x: Float[Tensor, "b c *n"]) -> Float[Tensor, "b c *m"]:
        return torch.cat([A(x) for A in self.parts], dim=2)

    def adjoint(self, y: Float[Tensor, "b c *m"]) -> Float[Tensor, "b c *n"]:
        pieces = y.split([A.range_shape[0] for A in self.parts], dim=2)
        return torch.stack([A.adjoint(p) for A, p in zip(self.parts, pieces, strict=True)]).sum(
            dim=0
        )
