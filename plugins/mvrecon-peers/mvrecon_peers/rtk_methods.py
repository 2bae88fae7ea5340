"""RTK's reconstruction filters on the CPU as methods: FDK, SART, conjugate gradients, TV.

The axis of rotation of the rig is the grid's z axis, as in `circular`; RTK's is y, so grid and rig
are first rotated by 90 degrees about x. Volumes are in 1/mm.
"""

from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from mvrecon.geometry.grid import Grid
from mvrecon.methods.classical.solver import check_no_gradient
from mvrecon.operators.checks import check_views
from mvrecon.operators.operator import Projector
from mvrecon_peers.rtk import Rtk

#: RTK's enumerators of its Joseph filters, forward and back.
JOSEPH = 0, 1
#: World (x, y, z) to RTK's (x, y, z): the axis of rotation becomes y.
TURN = ((1.0, 0.0, 0.0), (0.0, 0.0, 1.0), (0.0, -1.0, 0.0))


def rtk_fdk(
    A: Projector, views: Float[Tensor, "b 1 m v u"], cutoff: float = 1.0
) -> Float[Tensor, "b 1 d h w"]:
    """Feldkamp's method by RTK's FDKConeBeamReconstructionFilter, in 1/mm.

    Args:
        A: projector with grid and rig, a full circle about the grid's z axis.
        views: line integrals.
        cutoff: cutoff frequency of the Hann window, as a fraction of the Nyquist frequency; 0: ramp
            without window.

    Raises:
        ImportError: RTK is not installed.
        ValueError: a geometry that RTK does not support.
    """

    def configure(method: Any) -> None:
        method.GetRampFilter().SetHannCutFrequency(cutoff)

    return _reconstructed(A, views, "FDKConeBeamReconstructionFilter", configure)


def rtk_sirt(
    A: Projector, views: Float[Tensor, "b 1 m v u"], iterations: int = 50, relaxation: float = 1.0
) -> Float[Tensor, "b 1 d h w"]:
    """SIRT by RTK's SARTConeBeamReconstructionFilter, all views at once, in 1/mm.

    Args:
        A: projector with grid and rig.
        views: line integrals.
        iterations: number of iterations.
        relaxation: RTK's lambda.

    Raises:
        ImportError: RTK is not installed.
        ValueError: a geometry that RTK does not support.
    """
    return rtk_os_sart(A, views, iterations, len(A.cameras), relaxation)


def rtk_os_sart(
    A: Projector,
    views: Float[Tensor, "b 1 m v u"],
    iterations: int = 10,
    views_per_subset: int = 1,
    relaxation: float = 0.3,
) -> Float[Tensor, "b 1 d h w"]:
    """Ordered-subset SART by RTK's SARTConeBeamReconstructionFilter with Joseph filters, in 1/mm.

    Args:
        A: projector with grid and rig.
        views: line integrals.
        iterations: number of passes over all views.
        views_per_subset: number of views per update; 1 is SART.
        relaxation: RTK's lambda.

    Raises:
        ImportError: RTK is not installed.
        ValueError: a geometry that RTK does not support.
    """

    def configure(method: Any) -> None:
        _use_joseph(method)
        method.SetNumberOfIterations(iterations)
        method.SetNumberOfProjectionsPerSubset(views_per_subset)
        method.SetLambda(relaxation)
        method.SetEnforcePositivity(True)

    return _reconstructed(A, views, "SARTConeBeamReconstructionFilter", configure)


def rtk_cg(
    A: Projector, views: Float[Tensor, "b 1 m v u"], iterations: int = 20
) -> Float[Tensor, "b 1 d h w"]:
    """Conjugate gradients by RTK's ConjugateGradientConeBeamReconstructionFilter, in 1/mm.

    Args:
        A: projector with grid and rig.
        views: line integrals.
        iterations: number of iterations.

    Raises:
        ImportError: RTK is not installed.
        ValueError: a geometry that RTK does not support.
    """

    def configure(method: Any) -> None:
        _use_joseph(method)
        method.SetNumberOfIterations(iterations)

    return _reconstructed(A, views, "ConjugateGradientConeBeamReconstructionFilter", configure)


def rtk_tv(
    A: Projector,
    views: Float[Tensor, "b 1 m v u"],
    iterations: int = 20,
    cg_iterations: int = 5,
    tv_iterations: int = 10,
    gamma: float = 0.1,
) -> Float[Tensor, "b 1 d h w"]:
    """TV by RTK's RegularizedConjugateGradientConeBeamReconstructionFilter, in 1/mm.

    Alternates conjugate gradients, a positivity constraint and TV denoising.

    Args:
        A: projector with grid and rig.
        views: line integrals.
        iterations: number of alternations.
        cg_iterations: conjugate gradient iterations per alternation.
        tv_iterations: denoising iterations per alternation.
        gamma: RTK's weight of TV.

    Raises:
        ImportError: RTK is not installed.
        ValueError: a geometry that RTK does not support.
    """

    def configure(method: Any) -> None:
        _use_joseph(method)
        method.SetMainLoop_iterations(iterations)
        method.SetCG_iterations(cg_iterations)
        method.SetPerformPositivity(True)
        method.SetPerformTVSpatialDenoising(True)
        method.SetPerformWaveletsSpatialDenoising(False)
        method.SetTV_iterations(tv_iterations)
        method.SetGammaTV(gamma)

    return _reconstructed(
        A, views, "RegularizedConjugateGradientConeBeamReconstructionFilter", configure
    )


def _use_joseph(method: Any) -> None:
    method.SetForwardProjectionFilter(JOSEPH[0])
    method.SetBackProjectionFilter(JOSEPH[1])


def _reconstructed(A: Projector, views: Tensor, name: str, configure: Any) -> Tensor:
    check_views(views, A.cameras)
    check_no_gradient(f"RTK's {name}", views)
    turn = torch.tensor(TURN, dtype=torch.float64)
    depth, height, width = A.grid.shape
    grid = Grid((height, depth, width), _turned(A.grid, turn))
    rtk = Rtk(grid, A.cameras.moved(turn, torch.zeros(3, dtype=torch.float64)))
    volumes = [rtk.reconstruct(name, case[0].contiguous(), configure) for case in views]
    # from [y, z, x] with y downwards to [z, y, x]
    return torch.stack(volumes).flip(1).transpose(1, 2)[:, None].contiguous()


def _turned(grid: Grid, turn: Float[Tensor, "3 3"]) -> Float[Tensor, "4 4"]:
    """Affine of the same voxels in RTK's world, indexed along x, z and reversed y."""
    flipped = grid.affine.clone()
    flipped[:3, 3] += flipped[:3, 1] * (grid.shape[1] - 1)
    flipped[:3, 1] *= -1
    affine = torch.eye(4, dtype=torch.float64)
    affine[:3, :3] = turn @ flipped[:3, [0, 2, 1]]
    affine[:3, 3] = turn @ flipped[:3, 3]
    return affine
