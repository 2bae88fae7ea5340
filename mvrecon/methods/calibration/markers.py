"""Calibration from views of known markers: sub-pixel marker positions, projection matrices by the
direct linear transform, then a least-squares rig.
"""

from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from mvrecon.geometry.cameras.camera import Cameras
from mvrecon.geometry.cameras.convert import from_matrix
from mvrecon.geometry.cameras.random_rigs import Misalignment, misaligned
from mvrecon.geometry.grid import pixel_centres
from mvrecon.geometry.rigid import unit

#: Times that a window is re-centred on its marker.
CENTRINGS = 5
#: A marker must exceed its background by so many standard deviations of that.
MIN_CONTRAST = 5.0


def helix(
    count: int = 24, radius_mm: float = 40.0, height_mm: float = 80.0, turns: float = 2.0
) -> Float[Tensor, "n 3"]:
    """Return a marker phantom in world mm: balls on a helix about the z axis, in order.

    Args:
        count: number of balls, at least six.
        radius_mm, height_mm: radius and height of the helix in mm, its middle at the origin.
        turns: number of turns of the helix; not whole, so that no ball is above another.

    Raises:
        ValueError: fewer than six balls.
    """
    if count < 6:
        raise ValueError(f"expected at least six markers, got {count}")
    share = torch.linspace(0, 1, count, dtype=torch.float64)
    angle = 2 * torch.pi * turns * share
    height = (share - 0.5) * height_mm
    return torch.stack([radius_mm * angle.cos(), radius_mm * angle.sin(), height], dim=-1)


def centroids(
    views: Float[Tensor, "m v u"], guesses: Float[Tensor, "m n 2"], radius_px: float = 5.0
) -> Float[Tensor, "m n 2"]:
    """Return marker positions (u, v) in pixels: background-corrected centroids near the guesses.

    In a disc about the guess the background is a plane through its rim, and the disc is re-centred
    on the centroid `CENTRINGS` times. NaN where there is no marker, where the disc leaves the
    detector, and where another guess is within two radii. A ball's centroid differs from its
    centre's image by the cone's obliquity, far below a hundredth of a pixel for small balls.

    Args:
        views: integrals in which markers are bright.
        guesses: expected positions, as the nominal rig projects them.
        radius_px: radius of the disc, in pixels; must cover the marker and the error of the guess.

    Raises:
        ValueError: shapes that do not agree, or a radius below two pixels.
    """
    if guesses.ndim != 3 or guesses.shape[0] != len(views) or guesses.shape[2] != 2:
        raise ValueError(
            f"expected guesses [{len(views)} n 2], one row per view, got {list(guesses.shape)}"
        )
    if not radius_px >= 2:
        raise ValueError(f"expected a radius of at least 2 pixels, got {radius_px}")
    pixels = pixel_centres(views.shape[1:])
    result = torch.full_like(guesses, torch.nan, dtype=torch.float64)
    for m, (view, places) in enumerate(zip(views.double(), guesses.double(), strict=True)):
        apart = torch.cdist(places, places) + torch.diag(torch.full((len(places),), torch.inf))
        for n in (apart.amin(dim=1) > 2 * radius_px).nonzero()[:, 0].tolist():
            result[m, n] = _centroid(view, pixels, places[n], radius_px)
    return result


def _centroid(
    view: Float[Tensor, "v u"], pixels: Float[Tensor, "v u 2"], place: Tensor, radius: float
) -> Float[Tensor, "2"]:
    """The centroid of a marker near a place, in pixels; NaN where there is none."""
    last = place.new_tensor(view.shape[::-1]) - 1
    for _ in range(CENTRINGS):
        if not ((place - radius >= 0) & (place + radius <= last)).all():
            return place.new_full((2,), torch.nan)
        low = (place - radius).floor().long().tolist()
        window = tuple(slice(n, n + round(2 * radius) + 2) for n in reversed(low))
        values, at = view[window], pixels[window]
        # rounding does not decide whether pixels at the radius itself are within
        distance = (at - place).norm(dim=-1).round(decimals=6)
        slope = torch.cat([at - place, torch.ones_like(at[..., :1])], dim=-1)
        rim = (distance > radius - 1) & (distance <= radius)
        plane = torch.linalg.lstsq(slope[rim], values[rim][:, None]).solution
        above = values - (slope @ plane)[..., 0]
        spread = above[rim].std()
        weight = torch.where(distance <= radius, above, 0.0).clamp(min=0)
        if not weight.max() > MIN_CONTRAST * spread + 1e-12:
            return place.new_full((2,), torch.nan)
        # omit the lower part of the peak, so that noise of the rim has no weight
        weight = (weight - 0.1 * weight.max()).clamp(min=0)
        place = (weight[..., None] * at).sum(dim=(0, 1)) / weight.sum()
    return place


#: Fewest visible markers of a view: 11 unknowns, two numbers per marker.
MIN_MARKERS = 6
#: Least spread of the markers' depths relative to their mean; below, the beams are nearly parallel.
MIN_DEPTH_SPREAD = 2e-3
#: Levenberg-Marquardt: initial damping, maximum number of rounds, and the change of an unknown
#: (pixels, degrees, mm) that ends them.
INITIAL_DAMPING, MAX_ROUNDS, MIN_CHANGE = 1e-3, 40, 1e-7
#: Unknowns of each view in each field of `Misalignment`.
FIELD_WIDTHS = (2, 3, 3, 1)


class MarkerFit(NamedTuple):
    """A rig fitted to markers.

    Args:
        cameras: the rig.
        rms_px: root mean square reprojection error of each view, in pixels.
    """

    cameras: Cameras
    rms_px: Float[Tensor, " m"]


def dlt(points: Float[Tensor, "n 3"], uv: Float[Tensor, "m n 2"]) -> Float[Tensor, "m 3 4"]:
    """Return projection matrices from markers at known positions in mm and their images in pixels.

    The normalised direct linear transform (Hartley & Zisserman, Multiple View Geometry, algorithm
    7.1). The matrices have a unit third row, and give the markers' centre a positive depth.

    Args:
        points: positions of the markers in world mm.
        uv: their images (u, v), NaN where not visible.

    Raises:
        ValueError: shapes that do not agree, or a view with fewer than six markers or with markers
            in one plane, or of parallel beams.
    """
    points, uv = points.double(), uv.double()
    if points.ndim != 2 or points.shape[1] != 3 or uv.shape[1:] != (len(points), 2):
        raise ValueError(
            f"expected points [n 3] and images [m n 2], got {list(points.shape)} and "
            f"{list(uv.shape)}"
        )
    return torch.stack([_dlt(points, view, m) for m, view in enumerate(uv)])


def _dlt(points: Tensor, uv: Tensor, m: int) -> Float[Tensor, "3 4"]:
    """The projection matrix of the view m."""
    visible = uv.isfinite().all(dim=-1)
    if (count := int(visible.sum())) < MIN_MARKERS:
        raise ValueError(f"expected at least {MIN_MARKERS} markers in view {m}, got {count}")
    X, space = _normalised(points[visible])
    x, plane = _normalised(uv[visible])
    zero = torch.zeros_like(X)
    u_rows = torch.cat([X, zero, -x[:, :1] * X], dim=1)
    v_rows = torch.cat([zero, X, -x[:, 1:2] * X], dim=1)
    rows = torch.cat([u_rows, v_rows])
    _, singular, V = torch.linalg.svd(rows)
    if not singular[10] > 1e-8 * singular[0]:
        raise ValueError(f"expected markers of view {m} that are not coplanar, got coplanar ones")
    P = torch.linalg.inv(plane) @ V[11].reshape(3, 4) @ space
    depth = points @ P[2, :3] + P[2, 3]
    if not depth.std() > MIN_DEPTH_SPREAD * depth.mean().abs():
        raise ValueError(
            f"expected view {m} of a source at a finite distance, got markers all at one depth, as "
            f"parallel beams show them; calibrate those by calibrate=[offset_u,tilt]"
        )
    return P / P[2, :3].norm() * torch.sign(depth.mean())


def _normalised(points: Float[Tensor, "n k"]) -> tuple[Float[Tensor, "n l"], Float[Tensor, "l l"]]:
    """Homogeneous points centred and scaled to a mean distance of the root of their dimension, and
    the transform.
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
    """Fit a rig in mm, sources and rectangular detectors with known pixels, to images of known
    markers.

    The matrices of `dlt` initialise a least-squares fit of nine unknowns per view (source, detector
    position and rotation), by Levenberg-Marquardt steps through `Cameras.project`.

    Args:
        points: positions of the markers in world mm.
        uv: their images (u, v) in pixels, NaN where not visible; see `centroids`.
        shape: detector pixels (rows, columns).
        pixel_mm: pixel size (v, u).

    Returns:
        The fitted rig with the reprojection error of each view.

    Raises:
        ValueError: as `dlt`; or matrices that are left-handed: the rows of the views run upwards.

    Examples:
        >>> rig = mv.circular(2, sid=200, sdd=300, detector={"pixels": [64, 64], "pixel_mm": 1.0})
        >>> markers = mv.Grid.centred(2, spacing=20.0).corners()  # eight points, in mm
        >>> images = rig.project(markers)[..., :2]
        >>> fit = mv.from_markers(markers, images, shape=(64, 64), pixel_mm=(1.0, 1.0))
        >>> torch.allclose(fit.cameras.source, rig.source)
        True
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
    values = torch.zeros(len(P), 9, dtype=torch.float64)
    damping = torch.full((len(P),), INITIAL_DAMPING)
    cost = _residual(start, points, target, values).square().sum(dim=1)
    for _ in range(MAX_ROUNDS):
        r, J = _linearised(start, points, target, values)
        normal = J.mT @ J
        scaled = damping[:, None].double() * normal.diagonal(dim1=1, dim2=2)
        change = torch.linalg.solve(normal + torch.diag_embed(scaled), -(J.mT @ r[..., None]))
        trial = values + change[..., 0]
        new_cost = _residual(start, points, target, trial).square().sum(dim=1)
        better = new_cost < cost
        values = torch.where(better[:, None], trial, values)
        cost = torch.where(better, new_cost, cost)
        damping = torch.where(better, damping / 10, damping * 10).clamp(1e-12, 1e12)
        if change.abs().max() < MIN_CHANGE:
            break
    count = target.isfinite().all(dim=-1).sum(dim=1)
    return MarkerFit(_rig(start, values), (cost / count).sqrt())


def _rectangular(cameras: Cameras, pixel_mm: tuple[float, float]) -> Cameras:
    """The nearest rig with right angles and the given pixels, about the same detector centres."""
    right, down = unit(cameras.u), unit(cameras.v)
    aslant = (right * down).sum(dim=-1, keepdim=True) / 2
    right, down = unit(right - aslant * down), unit(down - aslant * right)
    down = unit(down - (down * right).sum(dim=-1, keepdim=True) * right)
    u, v = right * pixel_mm[1], down * pixel_mm[0]
    rows, columns = cameras.shape
    origin = cameras.detector_centre - u * (columns - 1) / 2 - v * (rows - 1) / 2
    return Cameras(cameras.source, origin, u, v, cameras.shape)


def _rig(start: Cameras, values: Float[Tensor, "m 9"]) -> Cameras:
    """The rig with the nine unknowns of each view."""
    return misaligned(start, Misalignment(*values.split(FIELD_WIDTHS, dim=-1)))


def _residual(
    start: Cameras, points: Tensor, uv: Tensor, values: Float[Tensor, "m 9"]
) -> Float[Tensor, "m k"]:
    """Reprojection errors (u, v) in pixels, zero for invisible markers."""
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
