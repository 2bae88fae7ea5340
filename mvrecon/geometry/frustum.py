"""Camera frusta as grids of (depth, row, column), and the warps between a frustum and the world.

A frustum's depth bins are slabs between two planes parallel to the detector. Their centres are
equally spaced in z, or in the homogeneous factor k = f / z, whose uniform samples lie coarsely far
from a central source.

Convention: frustum tensors are [.. d v u]; frustum indices are (u, v, d), integer at bin centres.
"""

from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor

Spacing = Literal["z", "k"]


def depth_edges(
    z_range: Float[Tensor, "m 2"], count: int, spacing: Spacing = "z"
) -> Float[Tensor, "m e"]:
    """The count + 1 planes that bound the depth bins of each camera, in mm.

    Raises:
        ValueError: an unknown spacing, or k = f / z asked for a range that holds z = 0.
    """
    if spacing not in ("z", "k"):
        raise ValueError(f"Depth spacing must be 'z' or 'k', got {spacing!r}")
    t = torch.linspace(0, 1, count + 1, dtype=z_range.dtype, device=z_range.device)
    near, far = z_range[:, :1], z_range[:, 1:]
    if spacing == "z":
        return near + (far - near) * t
    if (near * far <= 0).any():
        raise ValueError(
            f"Depths equally spaced in k = f/z need a range without z = 0, got {z_range.tolist()} "
            f"mm"
        )
    return 1 / (1 / near + (1 / far - 1 / near) * t)


def depth_index(
    z: Float[Tensor, "m *n"], edges: Float[Tensor, "m e"], spacing: Spacing = "z"
) -> Float[Tensor, "m *n"]:
    """Depth coordinate of z in mm: -1/2 at the first edge, integer at bin centres (in z, or in
    k).
    """
    pad = (len(edges),) + (1,) * (z.ndim - 1)
    near, far = edges[:, 0].reshape(pad), edges[:, -1].reshape(pad)
    count = edges.shape[1] - 1
    if spacing == "z":
        t = (z - near) / (far - near)
    else:
        t = (1 / z - 1 / near) / (1 / far - 1 / near)
    return t * count - 0.5


def depth_centres(edges: Float[Tensor, "m e"], spacing: Spacing = "z") -> Float[Tensor, "m d"]:
    """Depth z in mm of the bins' centres (the middle in z, or in k)."""
    if spacing == "z":
        return (edges[:, 1:] + edges[:, :-1]) / 2
    return 2 / (1 / edges[:, 1:] + 1 / edges[:, :-1])


def homography_jacobian(H: Float[Tensor, "*m 4 4"], w: Float[Tensor, "*m"]) -> Float[Tensor, "*m"]:
    """Volume of frustum coordinates per mm^3 of world, |det H| / w^4, where w is the last row of H
    times (X, 1).

    A density that is to keep its counts when it is warped is divided by it.
    """
    return torch.linalg.det(H).abs() / w**4
