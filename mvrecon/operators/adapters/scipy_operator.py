"""An operator for SciPy's solvers."""

from typing import Any

import numpy as np
import torch

from mvrecon.operators.adapters.missing import needs
from mvrecon.operators.operator import LinearOperator


def scipy_operator(A: LinearOperator, dtype: Any = np.float64) -> Any:
    """An operator as `scipy.sparse.linalg.LinearOperator`, in the unit of A (mm), so that
    `lsqr`, `lsmr`, `svds` and others work on it.

    Convention: SciPy's vectors are volumes [d h w] and views [m v u] of one sample and one channel,
    flattened with the last axis fastest.

    Args:
        A: the operator, on any device.
        dtype: of its products, float32 or float64.

    Raises:
        ImportError: SciPy is not installed.
        ValueError: another dtype.
    """
    with needs("scipy"):
        from scipy.sparse import linalg  # pyright: ignore[reportMissingImports]

    if np.dtype(dtype) not in (np.dtype(np.float32), np.dtype(np.float64)):
        raise ValueError(f"Expected the dtype float32 or float64, got {np.dtype(dtype)}")
    shape = (int(np.prod(A.range_shape)), int(np.prod(A.domain_shape)))

    @torch.no_grad()
    def product(operator: LinearOperator, vectors: np.ndarray) -> np.ndarray:
        """The columns of a matrix are the samples of a batch."""
        columns = np.ascontiguousarray(vectors.reshape(len(vectors), -1).T, dtype=dtype)
        batch = torch.from_numpy(columns).to(A.device)
        result = operator(batch.reshape(-1, 1, *operator.domain_shape))
        return result.reshape(len(batch), -1).T.cpu().numpy()

    return linalg.LinearOperator(
        dtype=np.dtype(dtype),
        shape=shape,
        matvec=lambda x: product(A, x),
        rmatvec=lambda y: product(A.T, y),
        matmat=lambda x: product(A, x),
        rmatmat=lambda y: product(A.T, y),
    )
