"""Bounding boxes of nonzero values in a pinhole's layers of magnification, and the blur within
them.
"""

from typing import NamedTuple

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int
from torch import Tensor


class Extent(NamedTuple):
    """Ranges of rows, columns and layers with nonzero values, from the first to one past the
    last.
    """

    top: int
    bottom: int
    left: int
    right: int
    near: int
    far: int


@torch.library.custom_op("mvrecon_spect::extents", mutates_args=())
def extents_of(layers: Tensor) -> Tensor:
    """`Extent` [m 6] of the nonzero values of each view in layers [n m v u k]."""
    size = layers.abs()  # `!= 0` and `any` take nine times as long in torch
    below = size.amax(dim=(0, 2)) != 0
    places = size.amax(dim=(0, 3, 4)) != 0, below.any(dim=2), below.any(dim=1)
    return torch.cat([torch.stack(_ends(occupied), dim=1) for occupied in places], dim=1)


@extents_of.register_fake
def _(layers):
    return layers.new_empty(layers.shape[1], 6, dtype=torch.int64)


@extents_of.register_vmap
def _(info, in_dims, layers):
    return extents_of(layers.movedim(in_dims[0], 0).flatten(0, 1)), None


def _ends(occupied: Bool[Tensor, "m s"]) -> tuple[Int[Tensor, " m"], Int[Tensor, " m"]]:
    """Index of the first true value of each row, and one past the last; (0, 0) if there is none."""
    low, behind = occupied.int().argmax(dim=1), occupied.flip(1).int().argmax(dim=1)
    return low, (occupied.shape[1] - behind) * occupied.any(dim=1)


def blurred(
    layers: Float[Tensor, "n m v u k"],
    kernels: Float[Tensor, "m k i j"],
    shape: tuple[int, int],
) -> Float[Tensor, "n m rows columns"]:
    """Views of the given shape from the nonzero values of their layers."""
    extents = (Extent(*extent) for extent in extents_of(layers.detach()).tolist())
    pairs = zip(layers.unbind(dim=1), kernels, extents, strict=True)
    return torch.stack([_blurred(*pair, shape) for pair in pairs], dim=1)


def _blurred(
    layers: Float[Tensor, "n v u k"],
    kernels: Float[Tensor, "k i j"],
    extent: Extent,
    shape: tuple[int, int],
) -> Float[Tensor, "n rows columns"]:
    """A view of the given shape from its layers; only pixels reached by the extent are blurred, the
    others are zero.
    """
    kernels = kernels[extent.near : extent.far]
    rows, columns = (n - 1 for n in kernels.shape[-2:])
    wide = (kernels.detach() != 0).any(dim=0)
    y, x = _rim(wide.any(dim=1)), _rim(wide.any(dim=0))
    top, bottom = max(extent.top - rows + y, 0), min(extent.bottom - y, shape[0])
    left, right = max(extent.left - columns + x, 0), min(extent.right - x, shape[1])
    if extent.near == extent.far or top >= bottom or left >= right:
        return layers.new_zeros(len(layers), *shape)
    down, across = slice(top + y, bottom + rows - y), slice(left + x, right + columns - x)
    planes = layers[:, down, across, extent.near : extent.far].movedim(-1, 1)
    inner = kernels[:, None, y : rows + 1 - y, x : columns + 1 - x]
    # explicit sum over layers: the sum within torch's convolution is 25 times slower
    view = F.conv2d(planes, inner, groups=planes.shape[1]).sum(dim=1)
    return F.pad(view, (left, shape[1] - right, top, shape[0] - bottom))


def blurred_whole(
    layers: Float[Tensor, "n m v u k"], kernels: Float[Tensor, "m k i j"]
) -> Float[Tensor, "n m rows columns"]:
    """Views from all pixels of their layers."""
    planes = layers.movedim(-1, 2).flatten(1, 2)
    images = F.conv2d(planes, kernels.flatten(0, 1)[:, None], groups=planes.shape[1])
    return images.unflatten(1, kernels.shape[:2]).sum(dim=2)


def _rim(wide: Bool[Tensor, " n"]) -> int:
    """Number of false values at each end of a symmetric row."""
    return int(wide.int().argmax())
