"""An operator for deepinv's algorithms, denoisers and training."""

from typing import Any

from mvrecon.operators.adapters.missing import needs
from mvrecon.operators.operator import LinearOperator


def deepinv_physics(A: LinearOperator) -> Any:
    """An operator as deepinv's `LinearPhysics`, in the unit of A (mm), differentiable as A is.

    Convention: deepinv's x are volumes [b c d h w] and its y are views [b c m v u], as here. Its
    step sizes refer to the norm of A: `physics.compute_norm` tells it, or divide A by it
    (`(1 / norm) * A`).

    Args:
        A: the operator; the physics computes on its device.

    Raises:
        ImportError: deepinv is not installed.
    """
    with needs("deepinv"):
        from deepinv.physics import LinearPhysics  # pyright: ignore[reportMissingImports]

    return LinearPhysics(
        A=lambda x, **_: A(x),
        A_adjoint=lambda y, **_: A.T(y),
        img_size=(1, *A.domain_shape),
    )
