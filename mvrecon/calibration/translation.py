"""Views moved by parts of a pixel, by products with small matrices."""

import torch
from jaxtyping import Float
from torch import Tensor

#: Pixels of each side that count in `translated`, and the longest shift in pixels.
REACH = LONGEST = 4


def translated(
    views: Float[Tensor, "b c m v u"], shift_px: Float[Tensor, "#b #m 2"]
) -> Float[Tensor, "b c m v u"]:
    """Views as detectors shifted by up to `LONGEST` pixels measure them, y(p) = x(p + s), in their
    unit; beyond the edge the edge's values go on.

    By a windowed sinc along columns and along rows (Lanczos, 8 pixels).
    """
    along_u, along_v = (
        _interpolation(shift_px[..., axis].to(views.dtype), views.shape[size])[:, None]
        for axis, size in ((0, -1), (1, -2))
    )
    return along_v @ views @ along_u.mT


def _interpolation(shift: Float[Tensor, "#b #m"], count: int) -> Float[Tensor, "#b #m n n"]:
    """Weights of pixels for values at their places plus a shift."""
    beyond = REACH + LONGEST
    places = torch.arange(count, dtype=shift.dtype, device=shift.device)
    pixels = torch.arange(-beyond, count + beyond, device=shift.device)
    apart = places[:, None] + shift[..., None, None] - pixels
    kernel = torch.sinc(apart) * torch.sinc(apart / REACH) * (apart.abs() < REACH)
    edge = torch.eye(count, dtype=shift.dtype, device=shift.device)[pixels.clamp(0, count - 1)]
    return kernel @ edge / kernel.sum(dim=-1, keepdim=True)
