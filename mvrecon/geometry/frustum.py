"""Depth bins of camera frusta, and the volume of frustum coordinates.

A frustum's depth bins are slabs between two planes parallel to the detector, equally spaced in z.

Convention: frustum tensors are [.. d v u]; frustum indices are (u, v, d), integer at bin centres.
"""

import torch
from jaxtyping import Float
from torch import Tensor


def depth_edges(z_range: Float[Tensor, "m 2"], count: int) -> Float[Tensor, "m e"]:
    """The count + 1 planes that bound the depth bins of each camera, in mm."""
    t = torch.linspace(0, 1, count + 1, dtype=z_range.dtype, device=z_range.device)
    near, far = z_range[:, :1], z_range[:, 1:]
    return near + (far - near) * t


def depth_index(z: Float[Tensor, "m *n"], edges: Float[Tensor, "m e"]) -> Float[Tensor, "m *n"]:
    """Depth coordinate of z in mm: -1/2 at the first edge, integer at bin centres."""
    pad = (len(edges),) + (1,) * (z.ndim - 1)
    near, far = edges[:, 0].reshape(pad), edges[:, -1].reshape(pad)
    return (z - near) / (far - near) * (edges.shape[1] - 1) - 0.5


def homography_jacobian(H: Float[Tensor, "*m 4 4"], w: Float[Tensor, "*m"]) -> Float[Tensor, "*m"]:
    """Volume of frustum coordinates per mm^3 of world, |det H| / w^4, where w is the last row of H
    times (X, 1).

    A density that is to keep its counts when it is warped is divided by it.
    """
    return torch.linalg.det(H).abs() / w**4
