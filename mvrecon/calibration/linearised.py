"""Views as a linear function of the rig's unknowns, about a rig and a volume."""

from collections.abc import Callable

import torch
from jaxtyping import Float
from torch import Tensor

from mvrecon.calibration.unknowns import Unknowns
from mvrecon.projectors.operator import LinearOperator

#: Pixels (degrees, or a hundredth of a gain's logarithm) to both sides of a difference quotient.
STEP = 0.1


def derivatives(
    views_at: Callable[[Tensor], Tensor], values: Float[Tensor, "m k"]
) -> Float[Tensor, "k m v u"]:
    """Derivatives of each view by its own numbers: central difference quotients.

    All views move at once, as none depends on another's numbers. Along blurred volumes the
    quotient is the derivative to the second order of its step; the kernels have a derivative by the
    pose backwards alone, and the reference's forwards takes some sixty times as long.

    Args:
        views_at: the views [1 1 m v u] of a volume, of the numbers.
        values: the numbers.
    """
    columns = []
    for direction in STEP * torch.eye(values.shape[1], dtype=values.dtype):
        ahead, behind = (views_at(values + side * direction) for side in (1, -1))
        columns.append((ahead - behind)[0, 0] / (2 * STEP))
    return torch.stack(columns)


class Complement(LinearOperator):
    """The part of views that no change of the rig's unknowns explains, an orthogonal projection.

    Args:
        columns: derivatives of each view by its own numbers.
        unknowns: the numbers that are free.
    """

    def __init__(self, columns: Float[Tensor, "k m v u"], unknowns: Unknowns):
        self.columns, basis = columns, unknowns.basis
        self.domain_shape = self.range_shape = tuple(columns.shape[1:])
        flat = columns.flatten(2).double()
        gram = torch.einsum("kmp,lmp->mkl", flat, flat).to(basis)
        normal = torch.einsum("mkn,mkl,mlo->no", basis, gram, basis)
        self._solution = basis @ torch.linalg.pinv(normal, rtol=1e-9, hermitian=True)
        self._basis = basis

    @property
    def device(self) -> torch.device:
        return self.columns.device

    def change(self, views: Float[Tensor, "1 1 m v u"]) -> Float[Tensor, "m k"]:
        """The change of the numbers that explains views best (least squares)."""
        products = torch.einsum("kmvu,mvu->mk", self.columns, views[0, 0]).to(self._basis)
        return self._solution @ torch.einsum("mkn,mk->n", self._basis, products)

    def forward(self, x: Float[Tensor, "1 1 m v u"]) -> Float[Tensor, "1 1 m v u"]:
        explained = torch.einsum("kmvu,mk->mvu", self.columns, self.change(x).to(self.columns))
        return x - explained

    def adjoint(self, y: Float[Tensor, "1 1 m v u"]) -> Float[Tensor, "1 1 m v u"]:
        return self.forward(y)
