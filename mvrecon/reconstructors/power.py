"""The norm of an operator, by the power method."""

import torch

from mvrecon.projectors.operator import LinearOperator


@torch.no_grad()
def power_norm(
    A: LinearOperator, iterations: int = 20, dtype: torch.dtype = torch.float32
) -> float:
    """The operator's norm |A|, its greatest singular value, in the unit of A (mm), by the power
    method.

    From below: the value rises with the iterations. For an operator without negative entries, such
    as a projector, 20 give three digits and more.

    Args:
        A: the operator.
        iterations: products with A^T A.
        dtype: of the computation.
    """
    random = torch.Generator().manual_seed(0)
    x = torch.rand(1, 1, *A.domain_shape, generator=random, dtype=dtype).to(A.device)
    size = torch.zeros((), dtype=dtype)
    for _ in range(iterations):
        x = A.T(A(x / x.norm().clamp_min(torch.finfo(dtype).tiny)))
        size = x.norm()
    return size.sqrt().item()
