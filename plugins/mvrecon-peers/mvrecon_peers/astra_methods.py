"""ASTRA's 2-D algorithms on the CPU as methods: FBP, SIRT and CGLS for stacks of parallel slices,
slice by slice on one thread. ASTRA's 3-D algorithms require a GPU.
"""

from collections.abc import Mapping
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from mvrecon.methods.classical.solver import check_no_gradient
from mvrecon.operators.checks import check_views
from mvrecon.operators.operator import Projector
from mvrecon_peers.astra import Astra


def astra_fbp(
    A: Projector, views: Float[Tensor, "b 1 m v u"], filter: str = "ram-lak", method: str = "linear"
) -> Float[Tensor, "b 1 d h w"]:
    """Filtered back-projection by ASTRA's FBP, in (unit of the views) / mm.

    Args:
        A: projector with grid and rig, parallel beams in the central planes of slices.
        views: line integrals.
        filter: ASTRA's name for the window of the ramp filter, such as "ram-lak" or "hann".
        method: ASTRA's projector, whose transpose is the back-projection; see `Astra`.

    Raises:
        ImportError: ASTRA is not installed.
        ValueError: a geometry that ASTRA does not support.
    """
    return _reconstructed(A, views, method, "FBP", 1, {"FilterType": filter})


def astra_sirt(
    A: Projector, views: Float[Tensor, "b 1 m v u"], iterations: int = 50, method: str = "linear"
) -> Float[Tensor, "b 1 d h w"]:
    """ASTRA's SIRT with a non-negativity constraint, in (unit of the views) / mm.

    Args:
        A: projector with grid and rig.
        views: line integrals.
        iterations: number of iterations.
        method: ASTRA's projector: see `Astra`.

    Raises:
        ImportError: ASTRA is not installed.
        ValueError: a geometry that ASTRA does not support.
    """
    return _reconstructed(A, views, method, "SIRT", iterations, {"MinConstraint": 0.0})


def astra_cgls(
    A: Projector, views: Float[Tensor, "b 1 m v u"], iterations: int = 20, method: str = "linear"
) -> Float[Tensor, "b 1 d h w"]:
    """Conjugate gradients for least squares by ASTRA's CGLS, in (unit of the views) / mm.

    Args:
        A: projector with grid and rig.
        views: line integrals.
        iterations: number of iterations.
        method: ASTRA's projector: see `Astra`.

    Raises:
        ImportError: ASTRA is not installed.
        ValueError: a geometry that ASTRA does not support.
    """
    return _reconstructed(A, views, method, "CGLS", iterations, {})


def _reconstructed(
    A: Projector,
    views: Tensor,
    method: str,
    algorithm: str,
    iterations: int,
    options: Mapping[str, Any],
) -> Tensor:
    check_views(views, A.cameras)
    check_no_gradient(f"ASTRA's {algorithm}", views)
    peer = Astra(A.grid, A.cameras, method)
    cases = [case[0].float() for case in views]
    volumes = [peer.reconstruct(algorithm, case, iterations, options) for case in cases]
    return torch.stack(volumes)[:, None]
