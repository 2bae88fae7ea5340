"""Volumes carried from one lattice to another: frustum to world, world to frustum, frustum to
frustum.
"""

from collections.abc import Sequence

from jaxtyping import Float
from torch import Tensor

from mvrecon.kernels.backends import kernels_for
from mvrecon.kernels.precision import wide
from mvrecon.kernels.rays.cuda.selfcheck import STORED
from mvrecon.kernels.warps import ops as warp_ops
from mvrecon.kernels.warps import reference as warp_reference
from mvrecon.kernels.warps.trial import differences


def warp(
    volumes: Float[Tensor, "b s c *v"],
    maps: Float[Tensor, "s k 5 2 3"],
    shape: Sequence[int],
    backend: str = "auto",
) -> Float[Tensor, "b s k c d h w"]:
    """Each volume s on the lattices of its k maps: trilinear, zero outside and behind a camera's
    source.

    Values fade to zero over one voxel outside the outermost centres. Order of accuracy: second in
    the voxel size. Differentiable in the volumes, twice, and in the maps; second derivatives in
    these are the reference's. Half and bfloat16 volumes are computed in float32 and given back as
    they came; places are float64.

    Args:
        volumes: values on s lattices; batch and channels share the work of finding the places.
        maps: from `geometry.lattice.lattice_maps`, float64.
        shape: samples (d, h, w) of the output.
        backend: "cpu" or "cuda" (compiled), "reference" (torch, any device), or "auto": compiled
            where it can be had on the tensors' device.

    Raises:
        ValueError: sizes that do not agree, an unknown back end, or one for tensors elsewhere.
        RuntimeError: "cuda" cannot be used, and why.
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
    chosen, _ = kernels_for(volumes, backend, "warp", differences)
    kernels = warp_reference if chosen == "reference" else warp_ops
    # a GPU reads half precision as it is
    x = volumes if chosen == "cuda" and volumes.dtype in STORED else wide(volumes)
    return kernels.warp(x, maps, list(shape)).to(volumes.dtype)
