"""What depends on the grid and the rig alone: the operator, the cameras' frusta, the weights of
SIRT.

It is made once for the grid, and once for every crop of it that a scene needs.
"""

import torch
from jaxtyping import Bool, Int
from torch import Tensor, nn

from mvrecon.cameras.camera import Cameras
from mvrecon.cameras.culling import views_that_see
from mvrecon.geometry.box import Box
from mvrecon.geometry.grid import Grid
from mvrecon.models.cropped import CroppedFrusta
from mvrecon.models.lift import Frusta
from mvrecon.models.window import brick_corners, window_of
from mvrecon.projectors.operator import Projector
from mvrecon.reconstruct.iterative import sirt_weights

#: Coarse bins, along each axis, that the coarsest level of the depth U-Net joins into one.
MULTIPLE = 4


class Geometry(nn.Module):
    """A projector, the fine and the coarse frusta of its cameras, and SIRT's inverse row and column
    sums.

    Args:
        projector: A.
        weights: (R, C) of A.
        frusta: (fine, coarse), where a model has cameras' opinions.
        views: which of the rig's cameras the projector has, those that see its grid; all, by
            default.
    """

    row: Tensor
    column: Tensor
    views: Tensor

    def __init__(
        self,
        projector: Projector,
        weights: tuple[Tensor, Tensor],
        frusta: tuple[Frusta, Frusta] | None = None,
        views: Int[Tensor, " k"] | None = None,
    ):
        super().__init__()
        self.projector = projector
        every = torch.arange(len(projector.cameras), device=weights[0].device)
        self.register_buffer("views", every if views is None else views, persistent=False)
        self.register_buffer("row", weights[0], persistent=False)
        self.register_buffer("column", weights[1], persistent=False)
        self.frusta = None if frusta is None else nn.ModuleList(frusta)

    @property
    def fine(self) -> Frusta:
        """Frusta of the detectors' own pixels."""
        return self._frusta(0)

    @property
    def coarse(self) -> Frusta:
        """Frusta of binned pixels and bins twice as deep."""
        return self._frusta(1)

    def _frusta(self, which: int) -> Frusta:
        found = None if self.frusta is None else self.frusta[which]
        if not isinstance(found, Frusta):
            raise ValueError("This geometry was made without frusta")
        return found


def whole_geometry(projector: Projector, binning: int | None = None) -> Geometry:
    """The geometry of a projector's own grid, with frusta of pixels binned by `binning`."""
    if binning is None:
        return Geometry(projector, sirt_weights(projector))
    grid, cameras = projector.grid, projector.cameras
    depth = max(grid.shape)
    frusta = Frusta(grid, cameras, depth), Frusta(grid, cameras.binned(binning), max(1, depth // 2))
    return Geometry(projector, sirt_weights(projector), frusta)


def cropped_geometry(
    whole: Geometry, box: Box, bricks: Bool[Tensor, "z y x"] | None = None
) -> Geometry:
    """The same for the voxels in a box, and the cameras that see any of it.

    What is equal to them is taken over, the rest made for them alone.

    Args:
        whole: of the grid.
        box: the voxels.
        bricks: of the box, those that may hold anything, from `held_bricks`: the frusta have no
            bins for others. None: all.
    """
    views = _seeing(whole.projector.cameras, whole.projector.grid.cropped(box)).to(whole.row.device)
    projector = whole.projector.cropped(box, views.tolist())
    weights = whole.row[:, :, views], whole.column[..., *box.slices]
    if whole.frusta is None:
        return Geometry(projector, weights, views=views)
    fine, coarse = whole.fine, whole.coarse
    grid, cameras, binning = (
        whole.projector.grid,
        projector.cameras,
        fine.shape[1] // coarse.shape[1],
    )
    binned = cameras.binned(binning)
    window = window_of(brick_corners(projector.grid, bricks), binned, coarse.edges[views], MULTIPLE)
    finer = window.scaled(2, binning)
    if fine.shape[0] % 2:  # coarse bins are no pairs of fine ones: both keep all of them
        window, finer = window.deep(coarse.shape[0]), finer.deep(fine.shape[0])
    frusta = (
        CroppedFrusta(fine, grid, cameras, box, finer, views),
        CroppedFrusta(coarse, grid, binned, box, window, views),
    )
    return Geometry(projector, weights, frusta, views).to(fine.step.device)


def _seeing(cameras: Cameras, grid: Grid) -> Int[Tensor, " k"]:
    """Which cameras see any of a grid; all of them, where none does."""
    seen = views_that_see(cameras, grid)
    return (seen if seen.any() else ~seen).nonzero()[:, 0]


def crop_of(whole: Geometry, box: Box, bricks: Bool[Tensor, "z y x"] | None = None) -> Geometry:
    """`cropped_geometry` that training may use although evaluation asked for it first."""
    with torch.inference_mode(False), torch.no_grad():
        return cropped_geometry(whole, box, bricks)
