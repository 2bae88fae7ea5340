"""Gaussian blur of volumes and of views, its own adjoint."""

from collections.abc import Sequence

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from mvrecon.core.numbers import divided
from mvrecon.operators.operator import LinearOperator


class Blur(LinearOperator):
    """Gaussian blur along the axes of a tensor, symmetric; outside of the tensor is zero.

    Args:
        shape: of a volume (d, h, w), or of views (m, v, u).
        sigmas: standard deviation along each axis, in voxels or pixels; 0: none.
        device: where the operator computes.
    """

    def __init__(
        self,
        shape: Sequence[int],
        sigmas: Sequence[float],
        device: torch.device | str = "cpu",
    ):
        self.domain_shape = self.range_shape = tuple(shape)
        self._bands = [
            _band(size, sigma, torch.device(device)) if sigma else None
            for size, sigma in zip(shape, sigmas, strict=True)
        ]
        self._device = torch.device(device)

    @property
    def device(self) -> torch.device:
        return self._device

    def forward(self, x: Float[Tensor, "b c *n"]) -> Float[Tensor, "b c *n"]:
        for axis, band in enumerate(self._bands, start=2):
            if band is not None:
                x = (x.movedim(axis, -1) @ band.to(x)).movedim(-1, axis)
        return x.contiguous()

    def adjoint(self, y: Float[Tensor, "b c *n"]) -> Float[Tensor, "b c *n"]:
        return self.forward(y)


def blurred(
    views: Float[Tensor, "b c m v u"], sigma_px: float, mask: Bool[Tensor, "m v u"] | None = None
) -> Float[Tensor, "b c m v u"]:
    """Views blurred by a Gaussian in their own unit, from the pixels inside the detector alone.

    Normalised convolution (Knutsson & Westin, Proc. CVPR 1993): the weights of the pixels that
    count add up to one; zero where there are none.

    Args:
        views: measured integrals.
        sigma_px: standard deviation along u and v, in pixels.
        mask: the pixels that count; None: all.
    """
    shape = views.shape[2:]
    blur = Blur(shape, (0.0, sigma_px, sigma_px), views.device)
    counts = views.new_ones(1, 1, *shape) if mask is None else mask[None, None].to(views)
    weight = blur(counts)
    total = blur(torch.where(counts > 0, views, 0.0))
    return divided(total, weight)


def _band(size: int, sigma: float, device: torch.device) -> Float[Tensor, "n n"]:
    """The weights of a Gaussian between the places of a row; the same whichever way they are read,
    which needs the sum of the unbounded row for all of them.
    """
    place = torch.arange(size, dtype=torch.float64, device=device)
    apart = (place[:, None] - place).abs()
    most = int(8 * sigma + 1)
    reach = torch.arange(-most, most + 1, dtype=torch.float64, device=device)
    return torch.exp(-((apart / sigma) ** 2) / 2) / torch.exp(-((reach / sigma) ** 2) / 2).sum()
