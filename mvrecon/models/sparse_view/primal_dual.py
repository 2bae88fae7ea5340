"""Learned primal-dual reconstruction."""

import torch
from jaxtyping import Float
from torch import Tensor, nn

from mvrecon.models.door import admitted
from mvrecon.models.output import Reconstruction
from mvrecon.models.sparse_view.filtered import sinograms
from mvrecon.models.start import anything, content_scale
from mvrecon.models.unet2d import by_slices
from mvrecon.projectors.operator import Projector
from mvrecon.reconstructors.iterative import SirtWeights, correction, sirt_weights


class PrimalDual(nn.Module):
    """Learned primal-dual: unrolled iterations of small networks on sinograms and on slices, with A
    and A^T between them.

    h <- h + D_k(h, A f_2, y), f <- f + P_k(f, A^T h_1), several channels of each, zero at first; A
    over its norm's upper bound, the root of its greatest row sum times its greatest column sum. Any
    rig (Adler and Oektem, IEEE Trans. Med. Imaging 37, 2018, algorithm 3).

    Args:
        projector: A, which holds the grid and the rig.
        iterations: as published 10.
        channels: of primal and of dual variables, at least 2.
        width: channels between the three convolutions of each network.

    Raises:
        ValueError: no iteration, or too few channels.
    """

    #: Its lengths are for the number of cameras it was built with.
    counts_cameras = True

    row: Tensor
    column: Tensor

    def __init__(
        self, projector: Projector, iterations: int = 10, channels: int = 5, width: int = 32
    ):
        super().__init__()
        if iterations < 1 or channels < 2 or width < 1:
            raise ValueError(
                f"Expected iterations of at least 1, channels of at least 2 and a width of at "
                f"least 1, got {iterations}, {channels} and {width}"
            )
        self.projector, self.channels = projector, channels
        row, column = sirt_weights(projector)
        self.register_buffer("row", row, persistent=False)
        self.register_buffer("column", column, persistent=False)
        self.norm = _norm_bound(row, column)
        self.dual = nn.ModuleList(
            SliceNetwork(channels + 2, channels, width) for _ in range(iterations)
        )
        self.primal = nn.ModuleList(
            SliceNetwork(channels + 1, channels, width) for _ in range(iterations)
        )

    def forward(self, views: Float[Tensor, "b 1 m v u"]) -> Reconstruction:
        views = admitted(views, self.projector.cameras, next(self.parameters()))
        with torch.no_grad():
            start = correction(self.projector, views, SirtWeights(self.row, self.column))
            scale = content_scale(start)
        y = views / (scale * self.norm)
        f = y.new_zeros(len(y), self.channels, *self.projector.grid.shape)
        h = y.new_zeros(len(y), self.channels, *y.shape[2:])
        for dual, primal in zip(self.dual, self.primal, strict=True):
            projected = self.projector(f[:, 1:2]) / self.norm
            h = h + sinograms(dual(sinograms(torch.cat([h, projected, y], dim=1))))
            f = f + primal(torch.cat([f, self.projector.T(h[:, :1]) / self.norm], dim=1))
        return Reconstruction(f[:, :1] * scale * anything(views), start=start)


class SliceNetwork(nn.Module):
    """Three 3x3 convolutions with PReLU between them map slices to slices, one by one."""

    def __init__(self, inputs: int, outputs: int, width: int):
        super().__init__()
        self.layers = nn.Sequential(
            nn.Conv2d(inputs, width, 3, padding=1),
            nn.PReLU(width),
            nn.Conv2d(width, width, 3, padding=1),
            nn.PReLU(width),
            nn.Conv2d(width, outputs, 3, padding=1),
        )

    def forward(self, x: Float[Tensor, "n i d h w"]) -> Float[Tensor, "n o d h w"]:
        return by_slices(self.layers, x)


def _norm_bound(row: Float[Tensor, "*r"], column: Float[Tensor, "*c"]) -> float:
    """The root of the greatest row sum times the greatest column sum, in mm (Schur's test), from
    their inverses, of which zeros count no sum.
    """
    sums = [1 / weights[weights > 0].double().min() for weights in (row, column) if weights.any()]
    return float(torch.stack(sums).prod().sqrt()) if sums else 1.0
