"""RTK's reconstruction filters on the CPU as methods: FDK, SART, conjugate gradients, TV.

The rig's axis of rotation is the grid's z axis, as in `circular`; RTK's is y, so grid and rig are
turned by 90 degrees about x first. Values go in and come out in 1/mm.
"""

from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from mvrecon.geometry.grid import Grid
from mvrecon.operators.operator import Projector, check_views
from mvrecon_peers.rtk import Rtk

#: RTK's numbers of its Joseph filters, forward and back.
JOSEPH = 0, 1
#: World x, y, z to RTK's x, y, z: the axis of rotation becomes y.
TURN = ((1.0, 0.0, 0.0), (0.0, 0.0, 1.0), (0.0, -1.0, 0.0))


def rtk_fdk(
    A: Projector, views: Float[Tensor, "b 1 m v u"], cutoff: float = 1.0
) -> Float[Tensor, "b 1 d h w"]:
    """Feldkamp's method by RTK's FDKConeBeamReconstructionFilter, in 1/mm.

    Args:
        A: holds the grid and the rig, a full circle about the grid's z axis.
        views: line integrals.
        cutoff: of the Hann window, as a fraction of the Nyquist frequency; 0: the ramp alone.

    Raises:
        ImportError: RTK is not installed.
        ValueError: a geometry that RTK does not take.
    """

    def configure(method: Any) -> None:
        method.GetRampFilter().SetHannCutFrequency(cutoff)

    return _reconstructed(A, views, "FDKConeBeamReconstructionFilter", configure)


def rtk_sirt(
    A: Projector, views: Float[Tensor, "b 1 m v u"], iterations: int = 50, relaxation: float = 1.0
) -> Float[Tensor, "b 1 d h w"]:
    """SIRT by RTK's SARTConeBeamReconstructionFilter, all views at once, in 1/mm.

    Args:
        A: holds the grid and the rig.
        views: line integrals.
        iterations: how many.
        relaxation: RTK's lambda.

    Raises:
        ImportError: RTK is not installed.
        ValueError: a geometry that RTK does not take.
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
        A: holds the grid and the rig.
        views: line integrals.
        iterations: over all views.
        views_per_subset: of one update; 1 is SART.
        relaxation: RTK's lambda.

    Raises:
        ImportError: RTK is not installed.
        ValueError: a geometry that RTK does not take.
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
        A: holds the grid and the rig.
        views: line integrals.
        iterations: how many.

    Raises:
        ImportError: RTK is not installed.
        ValueError: a geometry that RTK does not take.
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

    Conjugate gradients, then positivity and a TV denoising, in turns.

    Args:
        A: holds the grid and the rig.
        views: line integrals.
        iterations: of all three.
        cg_iterations: of the conjugate gradients in each.
        tv_iterations: of the denoising in each.
        gamma: RTK's weight of TV.

    Raises:
        ImportError: RTK is not installed.
        ValueError: a geometry that RTK does not take.
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
    turn = torch.tensor(TURN, dtype=torch.float64)
    depth, height, width = A.grid.shape
    grid = Grid((height, depth, width), _turned(A.grid, turn))
    rtk = Rtk(grid, A.cameras.moved(turn, torch.zeros(3, dtype=torch.float64)))
    volumes = [rtk.reconstruct(name, case[0].detach().contiguous(), configure) for case in views]
    # [y, z, x] with y running down: back to [z, y, x]
    return torch.stack(volumes).flip(1).transpose(1, 2)[:, None].contiguous()


def _turned(grid: Grid, turn: Float[Tensor, "3 3"]) -> Float[Tensor, "4 4"]:
    """The affine of the same voxels in RTK's world, counted along x, z and from the last y on."""
    flipped = grid.affine.clone()
    flipped[:3, 3] += flipped[:3, 1] * (grid.shape[1] - 1)
    flipped[:3, 1] *= -1
    affine = torch.eye(4, dtype=torch.float64)
    affine[:3, :3] = turn @ flipped[:3, [0, 2, 1]]
    affine[:3, 3] = turn @ flipped[:3, 3]
    return affine
