"""The source orbit about the axis of rotation, derived from the cameras.

The fan coordinate of a ray is the fan angle gamma between its projection onto the orbit's plane
and the central ray (radians), or a parallel ray's distance s from the isocentre (mm). Both grow
along the tangent.
"""

import warnings
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from mvrecon.geometry.cameras.camera import Cameras
from mvrecon.geometry.grid import Grid, voxel_centres
from mvrecon.geometry.rigid import rotation_by, unit

#: Greatest deviation of sources (relative to the radius) and of directions from the orbit.
MAX_ORBIT_DEVIATION = 0.05
#: Solutions that find the axis of parallel beams whose views differ in their panels' places.
REWEIGHTINGS = 20
#: The greatest cosine between detector rows and the axis of rotation: 15 degrees.
MAX_ROW_COSINE = 0.26
#: Width over height of flat objects, their error by tilted rays or rows and the loss of voxels that
#: rows of views miss, from which a warning is given, with the share of such voxels among at most so
#: many a side.
FLAT, WARNED_TILT, WARNED_LOSS, WARNED_VOXELS, MAX_COARSE_VOXELS = 5, 0.02, 0.02, 0.1, 12


@dataclass(frozen=True, eq=False)
class Orbit:
    """Sources on a circle, or parallel beams turned about an axis.

    Args:
        axis: direction of the axis of rotation, a unit vector.
        centre: the isocentre in world mm: the circle's centre; for parallel beams the place that
            all views have on the same column, nearest to the grid's centre.
        radius: mm from the axis to the sources (SID); infinite for parallel beams.
        outwards: unit vectors from the axis to the sources, or against the parallel rays.
    """

    axis: Float[Tensor, "3"]
    centre: Float[Tensor, "3"]
    radius: float
    outwards: Float[Tensor, "m 3"]

    @property
    def tangents(self) -> Float[Tensor, "m 3"]:
        """Unit vectors of the sources' motion with growing angle."""
        return torch.linalg.cross(self.axis.expand_as(self.outwards), self.outwards)

    @property
    def angles(self) -> Float[Tensor, " m"]:
        """Each source's angle about the axis in degrees, from the first one."""
        tangent = torch.linalg.cross(self.axis, self.outwards[0])
        return torch.rad2deg(torch.atan2(self.outwards @ tangent, self.outwards @ self.outwards[0]))

    def to(self, device: torch.device) -> "Orbit":
        """Move to a device."""
        axis, centre, outwards = (x.to(device) for x in (self.axis, self.centre, self.outwards))
        return replace(self, axis=axis, centre=centre, outwards=outwards)

    def cylinder(self, grid: Grid, margin: float = 0.5) -> tuple[float, Float[Tensor, "3"]]:
        """The radius in mm of the grid's inscribed cylinder along the axis, and the vector to it
        from the isocentre, across the axis; `margin` is how far the grid reaches beyond its
        outermost voxels' centres, in voxels.
        """
        steps = grid.affine[:3, :3].to(self.axis)
        along = (unit(steps, dim=0).T @ self.axis).abs().argmax()
        halves = steps.norm(dim=0) * (grid.centre_index.to(steps) + margin)
        offset = grid.centre.to(self.axis) - self.centre
        offset = offset - (offset @ self.axis) * self.axis
        return halves[torch.arange(3) != along].min().item(), offset

    def turned(self, cameras: Cameras, degrees: Float[Tensor, " m"]) -> Cameras:
        """Turn each camera about the axis by its own angle."""
        R = rotation_by(self.axis * degrees.deg2rad().to(self.axis)[:, None])

        def by(vectors: Tensor) -> Tensor:
            return (R @ vectors[..., None])[..., 0]

        source, origin = (
            by(points - self.centre) + self.centre for points in (cameras.source, cameras.origin)
        )
        return replace(cameras, source=source, origin=origin, u=by(cameras.u), v=by(cameras.v))


def orbit_of(cameras: Cameras, grid: Grid) -> Orbit:
    """Fit the circle of a rig's sources, or the rotation of its parallel beams, by least squares.

    The plane comes from the singular vectors, the circle from Kasa's linear fit (IEEE Trans.
    Instrum. Meas. 25, 1976).

    Raises:
        ValueError: sources that are not on a circle, directions that are not in a plane, or
            detector rows that run along the axis instead of across it.
    """
    with torch.no_grad():
        if not isinstance(cameras, Cameras):
            raise ValueError(
                "Filtered back-projection needs detectors with rows and columns, got "
                f"{type(cameras).__name__}; use sirt"
            )
        orbit = _turn(cameras, grid) if cameras.parallel else _circle(cameras)
        _check_rows(cameras, orbit)
        return orbit


def _turn(cameras: Cameras, grid: Grid) -> Orbit:
    beams = unit(cameras.origin - cameras.source)
    _, sizes, axes = torch.linalg.svd(beams, full_matrices=len(beams) < 3)
    if len(beams) < 2 or sizes[1] < 1e-6 * sizes[0]:
        raise ValueError(
            f"FBP needs parallel beams from two directions at least, got {len(beams)} views along "
            f"one line"
        )
    axis = _against(cameras.v, axes[2])
    if (leave := (beams @ axis).abs().max().item()) > MAX_ORBIT_DEVIATION:
        raise ValueError(
            f"FBP needs parallel beams that are turned about one axis, got directions that leave "
            f"their plane by up to {leave:.2g} of their length, expected at most "
            f"{MAX_ORBIT_DEVIATION}; use sirt"
        )
    outwards = unit(-beams + (beams @ axis)[:, None] * axis)
    orbit = Orbit(axis, grid.centre.to(axis), torch.inf, outwards)
    # the axis is projected onto one column of all views, if any place is, else of as many as may be
    # (least absolute deviations, reweighted); of several places it is the nearest to the grid
    across = torch.linalg.cross(axis, outwards[0])
    plane = torch.stack([outwards[0], across], dim=1)
    column = ((cameras.detector_centre - orbit.centre) * orbit.tangents).sum(dim=1)
    system = torch.cat([orbit.tangents @ plane, torch.ones_like(column)[:, None]], dim=1)
    shift, pixel = torch.linalg.pinv(system, rtol=1e-6) @ column, cameras.u.norm(dim=1).mean()
    for _ in range(REWEIGHTINGS):
        weight = (system @ shift - column).abs().clamp_min(1e-3 * pixel).rsqrt()
        shift = torch.linalg.pinv(weight[:, None] * system, rtol=1e-6) @ (weight * column)
    return replace(orbit, centre=orbit.centre + plane @ shift[:2])


def _circle(cameras: Cameras) -> Orbit:
    count, mean = len(cameras), cameras.source.mean(dim=0)
    places = cameras.source - mean
    extent = places.norm(dim=1).max()
    places = places / extent if extent > 0 else places  # independent of the unit of length
    _, sizes, axes = torch.linalg.svd(places, full_matrices=False)
    if count < 3 or sizes[1] < 1e-6 * sizes[0] or not sizes[0] > 0:
        raise ValueError(
            f"FDK needs at least three sources on a circle, got {count} on a line; use sirt"
        )
    flat = places @ axes[:2].T
    system = torch.cat([2 * flat, torch.ones_like(flat[:, :1])], dim=1)
    # normal equations: the last bits of LAPACK's lstsq depend on memory alignment
    fit = torch.linalg.solve(system.T @ system, system.T @ flat.square().sum(dim=1))
    radius = (fit[2] + fit[:2].square().sum()).sqrt().item()
    out = flat - fit[:2]
    off = torch.hypot(places @ axes[2], out.norm(dim=1) - radius).max().item()
    if not off <= MAX_ORBIT_DEVIATION * radius:
        raise ValueError(
            f"FDK needs sources on a circle, within {MAX_ORBIT_DEVIATION:.0%} of its radius, got "
            f"{count} sources that leave the best circle, of radius {extent * radius:.4g} mm, by "
            f"up to {extent * off:.4g} mm; use sirt"
        )
    centre, radius = mean + extent * (fit[:2] @ axes[:2]), extent.item() * radius
    return Orbit(_against(cameras.v, axes[2]), centre, radius, unit(out) @ axes[:2])


def _against(v: Float[Tensor, "m 3"], axis: Float[Tensor, "3"]) -> Float[Tensor, "3"]:
    """The axis that detector columns run against: a singular vector's sign is rounding's."""
    return torch.where((v @ axis).sum() > 0, -axis, axis)


def _check_rows(cameras: Cameras, orbit: Orbit) -> None:
    along = (unit(cameras.u) @ orbit.axis).abs()
    if (worst := along.max().item()) > MAX_ROW_COSINE:
        raise ValueError(
            f"The ramp filter runs along detector rows, which must be across the axis of rotation: "
            f"expected a cosine between them of at most {MAX_ROW_COSINE}, got {worst:.2g} in view "
            f"{int(along.argmax())}; if rows run along the axis, exchange rows and columns of "
            f"views and cameras"
        )


def warn_of_axial_errors(cameras: Cameras, orbit: Orbit, grid: Grid) -> None:
    """Warn of objects that filtered back-projection reads low or high by their height.

    Those a times as wide as high lose 1 - (1 + (a tan(tilt))^2)^-1/2, where the rays are tilted
    against the orbit's plane, as in laminography, and gain (1 + (a tan(roll))^2)^1/2 - 1, where the
    rows are.
    """
    back = cameras.origin if cameras.parallel else grid.centre.to(cameras.source)
    rays = unit(cameras.source - back)
    for vectors, what, power, word in (
        (unit(cameras.u), "Detector rows are rolled", 0.5, "high"),
        (rays, "Rays to the grid's centre are tilted", -0.5, "low"),
    ):
        share = (vectors @ orbit.axis).square().clamp_max(1 - 1e-6)
        slope = share / (1 - share)
        ball, flat = (
            ((1 + width**2 * slope).pow(power).mean() - 1).abs().item() for width in (1, FLAT)
        )
        if flat > WARNED_TILT:
            warnings.warn(
                f"{what} against the plane of the sources by "
                f"{slope.sqrt().atan().mean().rad2deg():.3g} degrees: filtered back-projection "
                f"reads compact objects {ball:.1%} {word}, and those {FLAT} times as wide as high "
                f"{flat:.0%}; use sirt",
                stacklevel=2,
            )


def beyond_rows(cameras: Cameras, orbit: Orbit, grid: Grid) -> str | None:
    """Which voxels rows of views do not reach, in words; None if these are few.

    A voxel of an object that extends beyond these rows loses the share of these views: at the top
    and the bottom of a box near the sources, and beside the slab that all views of a helix have in
    common. One that all views see whole loses nothing.
    """
    centres = _coarse_centres(orbit, grid).to(cameras.source)
    if not len(centres):
        return None
    rows = cameras.project(centres)[..., 1]
    losses = ((rows < -0.5) | (rows > cameras.shape[0] - 0.5)).double().mean(dim=0)
    share = (losses > WARNED_LOSS).double().mean().item()
    if share <= WARNED_VOXELS:
        return None
    along = (centres - grid.centre.to(centres)) @ orbit.axis
    whole = along[losses <= WARNED_LOSS]
    where = f"from {whole.min():.3g} to {whole.max():.3g} mm" if len(whole) else "nowhere"
    return (
        f"{share:.0%} of the voxels in the grid's inscribed cylinder are above or below the rows "
        f"of some views, and FDK reads an object that extends beyond these rows low there, by up "
        f"to {losses.max():.0%}; voxels that all views reach are {where} along the axis, from the "
        f"grid's centre. Take a lower grid, or use sirt"
    )


def warn_of_ends(cameras: Cameras, orbit: Orbit, grid: Grid) -> None:
    """Warn of voxels that lie before the sources or behind the detectors of some views: rays end
    there, so that these views add nothing to them.
    """
    centres = _coarse_centres(orbit, grid).to(cameras.source)
    lost = (~cameras.valid(cameras.project(centres))).double().mean(dim=0)
    if len(lost) and (most := lost.max().item()) > WARNED_LOSS:
        warnings.warn(
            f"{(lost > WARNED_LOSS).double().mean():.0%} of the voxels in the grid's inscribed "
            f"cylinder are before the sources or behind the detectors of up to {most:.0%} of the "
            f"views, where rays end: filtered back-projection reads them low by as much. Are the "
            f"distances right (sid and sdd, depth_mm of parallel beams)? Else take a smaller grid",
            stacklevel=2,
        )


def _coarse_centres(orbit: Orbit, grid: Grid) -> Float[Tensor, "n 3"]:
    """Centres of blocks of voxels in the grid's inscribed cylinder along the axis."""
    counts = [min(n, MAX_COARSE_VOXELS) for n in grid.size]
    centres = voxel_centres(grid.divided(counts)).reshape(-1, 3).to(orbit.axis)
    radius, offset = orbit.cylinder(grid)
    across = centres - orbit.centre - offset
    inside = across - (across @ orbit.axis)[:, None] * orbit.axis
    return centres[inside.norm(dim=-1) <= radius]


def fan_coordinate(
    cameras: Cameras, orbit: Orbit, u: Float[Tensor, " u"], v: Float[Tensor, " v"]
) -> Float[Tensor, "m v u"]:
    """The fan coordinate of the rays through pixels (u, v), in radians; in mm for parallel rays."""
    start = cameras.source - orbit.centre if cameras.parallel else cameras.origin - cameras.source
    across = along(start, cameras, orbit.tangents, u, v)
    if cameras.parallel:
        return across
    side = -1.0 if cameras.ray_extent[1] > 0 else 1.0  # a pinhole's detector is behind it
    ahead = along(start, cameras, side * orbit.outwards, u, v)
    return torch.atan2(-side * across, ahead)


def along(
    start: Float[Tensor, "m 3"],
    cameras: Cameras,
    direction: Float[Tensor, "m 3"],
    u: Float[Tensor, " u"],
    v: Float[Tensor, " v"],
) -> Float[Tensor, "m v u"]:
    """(start + u U + v V) . direction of pixels (u, v), in the dtype of u."""
    first, by_u, by_v = (
        (step * direction).sum(dim=-1)[:, None, None].to(u)
        for step in (start, cameras.u, cameras.v)
    )
    return first + by_v * v[:, None] + by_u * u
