"""The rays of a rig as lines in voxel space, linear in the pixel.

A pixel (u, v) has p = (u - uc, v - vc, 1), counted from the detector's centre. Its ray is the
Pluecker line with direction D(p) and moment M(p) = start(p) x D(p) about the volume's centre, in
voxel indices; both are linear in p, for central and parallel beams. Along the main axis a (the
greatest |D_a|) the ray has in slab s

    y_b(s) = (start_b D_a - start_a D_b + s D_b) / D_a = (h_b + s D_b) / D_a

in each other axis b. h_b is a component of the moment up to sign, computed in float64 without
cancellation, so that distant sources and world origins lose no precision (Pluecker coordinates:
Hartley & Zisserman, ch. 3.2).
"""

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from mvrecon.geometry.cameras.camera import Cameras, ExplicitRays
from mvrecon.geometry.grid import Grid

#: Discretisations of a ray's integral.
JOSEPH, SIDDON, TRILINEAR = 0, 1, 2
METHODS = {"joseph": JOSEPH, "siddon": SIDDON, "trilinear": TRILINEAR}
#: The four linear maps of a view in `lines_of`.
DIRECTION, MOMENT, START, WORLD = range(4)
#: Relative difference of components below which axes tie; the first of them is the main axis, in
#: every back end.
TIE = 1e-12


def numbered(method: str) -> tuple[int, int]:
    """The number of a method, and its samples per ray, as in "trilinear:samples"."""
    name, _, samples = method.partition(":")
    return METHODS[name], int(samples or 0)


def beside(tensor: Tensor, like: Tensor) -> Tensor:
    """Move a tensor to the type and device of another, without synchronisation."""
    return tensor.to(like, non_blocking=not like.is_cpu)


def lines_of(cameras: Cameras, grid: Grid) -> Float[Tensor, "m 4 3 3"]:
    """Return the rays of every view: matrices that map p to (direction, moment, start, direction in
    world mm).

    The first three are in voxel indices (x, y, z) about the volume's centre; float64, on the
    cameras' device, differentiable in the cameras.
    """
    rows, columns = cameras.shape
    centre, voxel = _voxels(grid, cameras.source)
    middle = cameras.u * ((columns - 1) / 2) + cameras.v * ((rows - 1) / 2)
    beam = cameras.origin - cameras.source + (0 if cameras.parallel else middle)
    source = (cameras.source - centre + (middle if cameras.parallel else 0)) @ voxel.T
    U, V, axis = cameras.u @ voxel.T, cameras.v @ voxel.T, beam @ voxel.T
    none = torch.zeros_like(U)
    if cameras.parallel:
        world, direction, start = (none, none, beam), (none, none, axis), (U, V, source)
        moment = tuple(torch.linalg.cross(vector, axis) for vector in start)
    else:
        # source x (detector - source) = source x detector
        detector = (cameras.origin - centre + middle) @ voxel.T
        world, direction, start = (cameras.u, cameras.v, beam), (U, V, axis), (none, none, source)
        moment = tuple(torch.linalg.cross(source, vector) for vector in (U, V, detector))
    maps = [torch.stack(columns, dim=-1) for columns in (direction, moment, start, world)]
    return torch.stack(maps, dim=1)


def lines_of_rays(rays: ExplicitRays, grid: Grid) -> Float[Tensor, "r 4 3 1"]:
    """Explicit rays, each as a view of one pixel: constant maps, as in `lines_of`."""
    centre, voxel = _voxels(grid, rays.source)
    source, target = rays.source.flatten(0, 2), rays.target.flatten(0, 2)
    start, end = ((points - centre) @ voxel.T for points in (source, target))
    maps = (end - start, torch.linalg.cross(start, end), start, target - source)
    return torch.stack(maps, dim=1)[..., None]


def _voxels(grid: Grid, like: Tensor) -> tuple[Float[Tensor, "3"], Float[Tensor, "3 3"]]:
    """The grid's centre in world mm, and the map from mm to voxels (x, y, z); on the device of
    `like`.
    """
    return beside(grid.centre, like), beside(torch.linalg.inv(grid.affine[:3, :3]), like)


def shifted(lines: Float[np.ndarray, "m 4 3 k"], y: float) -> Float[np.ndarray, "m 4 3 k"]:
    """The same rays about a point y voxels from the centre along the y axis."""
    if y == 0:
        return lines
    moved = lines.copy()
    # (start - o) x direction; the start is linear in the pixel except in its last column
    moved[:, START, 1, -1] -= y
    moved[:, MOMENT, 0] -= y * lines[:, DIRECTION, 2]
    moved[:, MOMENT, 2] += y * lines[:, DIRECTION, 0]
    return moved


def unshifted(change: Float[Tensor, "m 4 3 k"], y: float) -> Float[Tensor, "m 4 3 k"]:
    """The derivative by the rays of `lines_of` from that by `shifted` ones: the transpose of the
    linear part.
    """
    moved = change.clone()
    moved[:, DIRECTION, 2] -= y * change[:, MOMENT, 0]
    moved[:, DIRECTION, 0] += y * change[:, MOMENT, 2]
    return moved
