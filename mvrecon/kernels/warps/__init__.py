"""Warps of volumes between lattices: frustum to world, world to frustum, frustum to frustum."""

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from mvrecon.geometry.lattice import filled, lifted_maps, normalised, places, sample
from mvrecon.kernels.operator import LinearKernel, choose_backend, to_accumulation_dtype
from mvrecon.kernels.self_test import STORED, Errors


def normalised_places(
    maps: Float[Tensor, "*n 5 2 3"], source: Sequence[int], shape: Sequence[int]
) -> Float[Tensor, "*n d h w 3"]:
    """The positions of an output's samples in the source's box [-1, 1]; invalid ones are
    outside.
    """
    place, counts = places(maps, (shape[0], shape[1], shape[2]))
    centre = filled([(size - 1) / 2 for size in source[::-1]], place)
    points = normalised(place + centre, (source[0], source[1], source[2]))
    return torch.where(counts[..., None], points, 4.0)


def warp_reference(
    volumes: Float[Tensor, "n s c d h w"], maps: Float[Tensor, "s k 5 2 3"], shape: Sequence[int]
) -> Float[Tensor, "n s k c d h w"]:
    """Warp each volume s by its k maps: trilinear, fading to zero over one voxel outside, zero
    behind a source; plain torch, with derivatives of any order.
    Args:
        volumes: values on the source lattices.
        maps: maps as `geometry.lattice` gives them, float64.
        shape: samples (d, h, w) of the output.
    """
    points = normalised_places(maps, volumes.shape[3:], shape).to(volumes.dtype)  # [s k d h w 3]
    pairs = points.expand(len(volumes), *points.shape).flatten(0, 2)
    sources = volumes[:, :, None].expand(-1, -1, maps.shape[1], -1, -1, -1, -1).flatten(0, 2)
    return sample(sources, pairs).unflatten(0, (*volumes.shape[:2], maps.shape[1]))


WARP = LinearKernel(
    "warp(Tensor volumes, Tensor maps, SymInt[] shape) -> Tensor",
    "warp_transpose(Tensor values, Tensor maps, SymInt[] shape) -> Tensor",
    "warp_vjp(Tensor volumes, Tensor values, Tensor maps) -> Tensor",
    {"cpu": "mvrecon.kernels.warps.cpu", "cuda": "mvrecon.kernels.warps.cuda"},
    warp_reference,
    shapes=(
        lambda x, maps, shape: (*x.shape[:2], maps.shape[1], x.shape[2], *shape),
        lambda y, maps, shape: (*y.shape[:2], y.shape[3], *shape),
    ),
    sizes=(slice(3, 6), slice(4, 7)),
)


def warp(
    volumes: Float[Tensor, "b s c *v"],
    maps: Float[Tensor, "s k 5 2 3"],
    shape: Sequence[int],
    backend: str = "auto",
) -> Float[Tensor, "b s k c d h w"]:
    """Warp each volume s to the lattices of its k maps: trilinear, zero outside and behind a
    camera's source.

    Values fade to zero over one voxel beyond the outermost centres. Second order in the voxel size.
    Differentiable in the volumes, twice, and in the maps; second derivatives in these use the
    reference. Half and bfloat16 volumes are computed in float32 and returned in their dtype;
    positions are float64.

    Args:
        volumes: values on s lattices; batch and channels share the computation of positions.
        maps: maps as `geometry.lattice.lattice_maps` gives them, float64.
        shape: samples (d, h, w) of the output.
        backend: "cpu" or "cuda" (compiled), "reference" (torch, any device), or "auto": compiled if
            available on the tensors' device.

    Raises:
        ValueError: inconsistent sizes, an unknown back end, or one of another device.
        RuntimeError: "cuda" is not available, with the reason.
    """
    if (
        volumes.ndim != 6
        or maps.ndim != 5
        or maps.shape[2:] != (5, 2, 3)
        or len(maps) != volumes.shape[1]
    ):
        raise ValueError(
            "Expected volumes [b s c d h w] and maps [s k 5 2 3] of the same s, "
            f"got {tuple(volumes.shape)} and {tuple(maps.shape)}"
        )
    chosen = choose_backend(volumes, backend, "warp", self_test)
    act = warp_reference if chosen == "reference" else WARP.forward
    # a GPU reads half precision directly
    x = volumes if chosen == "cuda" and volumes.dtype in STORED else to_accumulation_dtype(volumes)
    return act(x, maps, list(shape)).to(volumes.dtype)


def self_test(device: str, dtype: torch.dtype, purpose: str) -> Errors:
    """Warps between diverging lattices."""
    generator = torch.Generator().manual_seed(0)
    H = torch.randn(2, 3, 4, 4, generator=generator, dtype=torch.float64)
    lifts = torch.tensor([[1.0, 0.05], [0.9, 0.1], [1.0, 0.0]], dtype=torch.float64)
    maps = lifted_maps(torch.eye(4).double() + 0.05 * H, lifts[:2, None], lifts).to(device)
    x = torch.randn(2, 2, 3, 4, 5, 6, generator=generator).to(device, dtype)
    yield from WARP.self_test(x, maps, [5, 4, 7])
