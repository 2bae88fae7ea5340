"""Calibration from views of known markers: projection matrices by the direct linear transform, then
a rig by least squares.
"""

from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from mvrecon.geometry.cameras.camera import Cameras
from mvrecon.geometry.cameras.convert import from_matrix
from mvrecon.geometry.cameras.misalignment import Misalignment, misaligned
from mvrecon.geometry.rigid import unit

#: The least number of markers that a view must show, for 11 unknowns from two numbers a marker.
LEAST = 6
#: Levenberg and Marquardt's damping: its start, the rounds at most, and the change of an unknown
#: (pixels, degrees, mm) below which they end.
DAMPING, ROUNDS, SMALL = 1e-3, 40, 1e-7
#: Unknowns of each view in each field of `Misalignment`.
WIDTHS = (2, 3, 3, 1)


class MarkerFit(NamedTuple):
    """A rig that markers were fitted to.

    Args:
        cameras: the rig.
        rms_px: root mean square distance of the markers from their images, view by view, in pixels.
    """

    cameras: Cameras
    rms_px: Float[Tensor, " m"]


def dlt(points: Float[Tensor, "n 3"], uv: Float[Tensor, "m n 2"]) -> Float[Tensor, "m 3 4"]:
    """Projection matrices from markers at known places in mm and their images in pixels.

    The normalised direct linear transform (Hartley & Zisserman, Multiple View Geometry, algorithm
    7.1). The matrices have a unit third row, and put the markers' middle at a positive depth.

    Args:
        points: places of the markers in world mm.
        uv: their images (u, v), NaN where one is not visible.

    Raises:
        ValueError: shapes that do not agree, or a view with fewer than six markers or with markers
            in one plane.
    """
    points, uv = points.double(), uv.double()
    if points.ndim != 2 or points.shape[1] != 3 or uv.shape[1:] != (len(points), 2):
        raise ValueError(
            f"expected points [n 3] and images [m n 2], got {list(points.shape)} and "
            f"{list(uv.shape)}"
        )
    return torch.stack([_dlt(points, view, m) for m, view in enumerate(uv)])


def _dlt(points: Tensor, uv: Tensor, m: int) -> Float[Tensor, "3 4"]:
    visible = uv.isfinite().all(dim=-1)
    if (count := int(visible.sum())) < LEAST:
        raise ValueError(f"expected at least {LEAST} markers in view {m}, got {count}")
    X, space = _normalised(points[visible])
    x, plane = _normalised(uv[visible])
    zero = torch.zeros_like(X)
    rows = torch.cat(
        [
            torch.cat([X, zero, -x[:, :1] * X], dim=1),
            torch.cat([zero, X, -x[:, 1:2] * X], dim=1),
        ]
    )
    _, singular, V = torch.linalg.svd(rows)
    if not singular[10] > 1e-8 * singular[0]:
        raise ValueError(f"expected markers of view {m} that are not in one plane, got such")
    P = torch.linalg.inv(plane) @ V[11].reshape(3, 4) @ space
    P = P / P[2, :3].norm()
    middle = torch.cat([points.mean(dim=0), points.new_ones(1)])
    return P * torch.sign(P[2] @ middle)


def _normalised(points: Float[Tensor, "n k"]) -> tuple[Float[Tensor, "n l"], Float[Tensor, "l l"]]:
    """Homogeneous points about their middle, their mean distance the root of their dimension, and
    the map that makes them so.
    """
    size = points.shape[1]
    middle = points.mean(dim=0)
    scale = size**0.5 / (points - middle).norm(dim=1).mean()
    T = torch.eye(size + 1).to(points)
    T[:size, :size] *= scale
    T[:size, size] = -scale * middle
    homogeneous = torch.cat([points, points.new_ones(len(points), 1)], dim=1)
    return homogeneous @ T.T, T


def from_markers(
    points: Float[Tensor, "n 3"],
    uv: Float[Tensor, "m n 2"],
    shape: tuple[int, int],
    pixel_mm: tuple[float, float],
) -> MarkerFit:
    """Rig in mm from images in pixels of markers at known places: sources, and rectangular
    detectors of known pixels.

    The matrices of `dlt` start a least-squares fit of nine unknowns a view (source, detector's
    place, its turn), by Levenberg's and Marquardt's steps through `Cameras.project`.

    Args:
        points: places of the markers in world mm.
        uv: their images (u, v) in pixels, NaN where one is not visible; see `centroids`.
        shape: detector pixels (rows, columns).
        pixel_mm: pixel size (v, u).

    Raises:
        ValueError: as `dlt`; or matrices that are left-handed: the rows of the views run upwards.
    """
    P = dlt(points, uv)
    if (torch.linalg.det(P[:, :, :3]) <= 0).any():
        raise ValueError(
            "expected views whose rows run downwards, got markers that are mirrored; reverse the "
            "rows of the views, or check the order of the markers"
        )
    pitch = from_matrix(P, shape, 1.0).u.norm(dim=-1)
    start = _rectangular(from_matrix(P, shape, pixel_mm[1] / pitch), pixel_mm)
    target = uv.double()
    values, damping = torch.zeros(len(P), 9, dtype=torch.float64), torch.full((len(P),), DAMPING)
    cost = _residual(start, points, target, values).square().sum(dim=1)
    for _ in range(ROUNDS):
        r, J = _linearised(start, points, target, values)
        normal = J.mT @ J
        scaled = damping[:, None].double() * normal.diagonal(dim1=1, dim2=2)
        change = torch.linalg.solve(normal + torch.diag_embed(scaled), -(J.mT @ r[..., None]))
        trial = values + change[..., 0]
        tried = _residual(start, points, target, trial).square().sum(dim=1)
        better = tried < cost
        values, cost = torch.where(better[:, None], trial, values), torch.where(better, tried, cost)
        damping = torch.where(better, damping / 10, damping * 10).clamp(1e-12, 1e12)
        if change.abs().max() < SMALL:
            break
    count = target.isfinite().all(dim=-1).sum(dim=1)
    return MarkerFit(_rig(start, values), (cost / count).sqrt())


def _rectangular(cameras: Cameras, pixel_mm: tuple[float, float]) -> Cameras:
    """The nearest rig with right angles and the given pixels, about the same detectors' middles."""
    right, down = unit(cameras.u), unit(cameras.v)
    aslant = (right * down).sum(dim=-1, keepdim=True) / 2
    right, down = unit(right - aslant * down), unit(down - aslant * right)
    down = unit(down - (down * right).sum(dim=-1, keepdim=True) * right)
    u, v = right * pixel_mm[1], down * pixel_mm[0]
    rows, columns = cameras.shape
    origin = cameras.detector_centre - u * (columns - 1) / 2 - v * (rows - 1) / 2
    return Cameras(cameras.source, origin, u, v, cameras.shape)


def _rig(start: Cameras, values: Float[Tensor, "m 9"]) -> Cameras:
    return misaligned(start, Misalignment(*values.split(WIDTHS, dim=-1)))


def _residual(
    start: Cameras, points: Tensor, uv: Tensor, values: Float[Tensor, "m 9"]
) -> Float[Tensor, "m k"]:
    """Distances (u, v) of projected from measured markers in pixels, zero for those not visible."""
    difference = _rig(start, values).project(points.double())[..., :2] - uv
    return torch.where(uv.isfinite(), difference, 0.0).flatten(1)


def _linearised(
    start: Cameras, points: Tensor, uv: Tensor, values: Float[Tensor, "m 9"]
) -> tuple[Float[Tensor, "m k"], Float[Tensor, "m k 9"]]:
    """The residual and its derivatives by the nine unknowns of each view (forward mode)."""

    def residual(x: Tensor) -> Tensor:
        return _residual(start, points, uv, x)

    directions = torch.eye(9, dtype=torch.float64)
    columns = [
        torch.func.jvp(residual, (values,), (direction.expand_as(values),))[1]
        for direction in directions
    ]
    return residual(values), torch.stack(columns, dim=-1)  # type: ignore[arg-type]
