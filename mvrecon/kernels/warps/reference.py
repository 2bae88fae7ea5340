"""The oracle of the warps: plain torch on any device, derivatives of any order by torch itself."""

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from mvrecon.geometry.lattice import places
from mvrecon.geometry.sample import filled, normalised, sample


def normalised_places(
    maps: Float[Tensor, "*n 5 2 3"], source: Sequence[int], shape: Sequence[int]
) -> Float[Tensor, "*n d h w 3"]:
    """The places of an output's samples in the source's box, which is [-1, 1]; those that do not
    count lie outside.
    """
    place, counts = places(maps, (shape[0], shape[1], shape[2]))
    centre = filled([(size - 1) / 2 for size in source[::-1]], place)
    points = normalised(place + centre, (source[0], source[1], source[2]))
    return torch.where(counts[..., None], points, 4.0)


def warp(
    volumes: Float[Tensor, "n s c d h w"], maps: Float[Tensor, "s k 5 2 3"], shape: Sequence[int]
) -> Float[Tensor, "n s k c d h w"]:
    """Each volume s as its k maps show it: trilinear, fading to zero over one voxel outside, zero
    behind a source.

    Args:
        volumes: values on the source lattices.
        maps: from `geometry.lattice`, float64.
        shape: samples (d, h, w) of the output.
    """
    points = normalised_places(maps, volumes.shape[3:], shape).to(volumes.dtype)  # [s k d h w 3]
    pairs = points.expand(len(volumes), *points.shape).flatten(0, 2)
    sources = volumes[:, :, None].expand(-1, -1, maps.shape[1], -1, -1, -1, -1).flatten(0, 2)
    return sample(sources, pairs).unflatten(0, (*volumes.shape[:2], maps.shape[1]))
