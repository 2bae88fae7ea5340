"""Unrolled iterations: networks alternating with filtered back-projections of the residual (ItNet),
and learned primal-dual.
"""

from typing import get_args

import torch
from jaxtyping import Float
from torch import Tensor, nn

from mvrecon.core.registry import check_choice
from mvrecon.methods.classical.fdk import Filter
from mvrecon.methods.learned.geometry import geometry_of, validated
from mvrecon.methods.learned.start import content_scale, nonzero
from mvrecon.methods.method import Reconstruction
from mvrecon.operators.memo import kept
from mvrecon.operators.operator import Projector
from mvrecon_baselines.sparse_view import filtered, full_precision, scaled, sinograms
from mvrecon_baselines.unet2d import UNet2d, by_slices


class ItNet(nn.Module):
    """Alternates a network, x <- x + U(x), and a filtered back-projection of the residual, x <- x +
    lambda_k FBP(y - A x), in (unit of the views) / mm.

    The initial x is FBP(y); the last operation is a data consistency step. The step lengths
    lambda_k are learned, in units of 1 / growth, where growth is the spectral radius of FBP A: with
    few views it is far above one, since filtered back-projection then overshoots near the axis. The
    network passes a few channels to its next call (Genzel, Guehring, Macdonald and Maerz,
    Near-exact recovery for tomographic inverse problems via deep learning, ICML 2022).

    Args:
        iterations: number of iterations of network and step.
        memory: channels passed from one call of the network to the next.
        shared: use one network for all iterations instead of one each.
        width, levels: width and levels of the network on slices, see `UNet2d`.
        filter: window of the ramp, as in `fbp`.

    Raises:
        ValueError: no iterations, a negative number of channels, or an unknown filter.
    """

    def __init__(
        self,
        iterations: int = 4,
        memory: int = 5,
        shared: bool = True,
        width: int = 32,
        levels: int = 4,
        filter: Filter = "ram-lak",
    ):
        super().__init__()
        if iterations < 1 or memory < 0:
            raise ValueError(
                f"Expected at least one iteration and at least 0 channels of memory, got "
                f"iterations {iterations}, memory {memory}"
            )
        self.memory = memory
        check_choice("filter", filter, get_args(Filter))
        self.filter: Filter = filter
        self.lengths = nn.Parameter(torch.ones(iterations))
        self.nets = nn.ModuleList(
            UNet2d(1 + memory, 1 + memory, width, levels, zero=1)
            for _ in range(1 if shared else iterations)
        )

    def forward(self, views: Float[Tensor, "b 1 m v u"], A: Projector) -> Reconstruction:
        y = validated(views, A, self.lengths)
        with full_precision(y):
            y, start, scale = scaled(A, y, self.filter)
            longest = kept(A, ("growth", self.filter), lambda: growth(A, self.filter))
            x = start
            state = x.new_zeros(len(x), self.memory, *x.shape[2:])
            for number, length in enumerate(self.lengths):
                answer = self.nets[number % len(self.nets)](torch.cat([x, state], dim=1))
                x, state = x + answer[:, :1], answer[:, 1:]
                x = x + length / longest * filtered(A, y - A(x), self.filter)
        return Reconstruction(x * scale, start=start * scale)


@torch.no_grad()
def growth(A: Projector, filter: Filter = "ram-lak", iterations: int = 15) -> float:
    """Spectral radius of FBP A by the power method, dimensionless; at least one.

    With steps of at most 2 / growth the iteration x <- x + step FBP(y - A x) stays bounded.
    """
    random = torch.Generator().manual_seed(0)
    x = torch.rand(1, 1, *A.domain_shape, generator=random, dtype=torch.float64).to(A.device)
    factor = torch.ones(())
    for _ in range(iterations):
        image = filtered(A, A(x), filter)
        factor = image.norm() / x.norm()
        if not factor > 0:  # no ray meets the grid
            break
        x = image / image.norm()
    return max(1.0, factor.item())


class PrimalDual(nn.Module):
    """Learned primal-dual: unrolled iterations of small networks on sinograms and on slices, with A
    and A^T between them, in (unit of the views) / mm.

    h <- h + D_k(h, A f_2, y), f <- f + P_k(f, A^T h_1), with several channels each, initially zero;
    A is divided by an upper bound of its norm. Supports any rig (Adler and Oektem, IEEE Trans. Med.
    Imaging 37, 2018, algorithm 3).

    Args:
        iterations: number of iterations; 10 as published.
        channels: number of primal and of dual channels, at least 2.
        width: channels between the three convolutions of each network.

    Raises:
        ValueError: no iterations, or too few channels.
    """

    averages = False  # three copies of a view count as more than one

    def __init__(self, iterations: int = 10, channels: int = 5, width: int = 32):
        super().__init__()
        if iterations < 1 or channels < 2 or width < 1:
            raise ValueError(
                f"Expected iterations of at least 1, channels of at least 2 and a width of at "
                f"least 1, got {iterations}, {channels} and {width}"
            )
        self.channels = channels
        self.dual = nn.ModuleList(
            SliceNetwork(channels + 2, channels, width) for _ in range(iterations)
        )
        self.primal = nn.ModuleList(
            SliceNetwork(channels + 1, channels, width) for _ in range(iterations)
        )

    def forward(self, views: Float[Tensor, "b 1 m v u"], A: Projector) -> Reconstruction:
        y = validated(views, A, next(self.parameters()))
        norm = kept(A, ("norm bound", y.dtype), lambda: norm_bound(A, y.dtype))
        start = geometry_of(y, A).direction(y)
        scale = content_scale(start)
        y = y / (scale * norm)
        f = y.new_zeros(len(y), self.channels, *A.domain_shape)
        h = y.new_zeros(len(y), self.channels, *A.range_shape)
        for dual, primal in zip(self.dual, self.primal, strict=True):
            projected = A(f[:, 1:2]) / norm
            h = h + sinograms(dual(sinograms(torch.cat([h, projected, y], dim=1))))
            f = f + primal(torch.cat([f, A.T(h[:, :1]) / norm], dim=1))
        return Reconstruction(f[:, :1] * scale * nonzero(views), start=start)


class SliceNetwork(nn.Module):
    """Three 3x3 convolutions with PReLU between them, applied to slices one by one."""

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


@torch.no_grad()
def norm_bound(A: Projector, dtype: torch.dtype = torch.float32) -> Float[Tensor, "#b 1 1 1 1"]:
    """Upper bound of the norm of A in mm: square root of its greatest row sum times its greatest
    column sum (Schur's test); one if A is zero.
    """
    rows = A(torch.ones(1, 1, *A.domain_shape, dtype=dtype, device=A.device))
    columns = A.T(torch.ones_like(rows))
    bound = rows.amax((1, 2, 3, 4), keepdim=True) * columns.amax((1, 2, 3, 4), keepdim=True)
    return torch.where(bound > 0, bound, 1).sqrt()
