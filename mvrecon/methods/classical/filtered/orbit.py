"""The path of the sources about the axis of rotation, worked out from the camera record."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from mvrecon.geometry.cameras.camera import Cameras
from mvrecon.geometry.grid import Grid
from mvrecon.geometry.rigid import unit

#: By how much of the circle's radius a source, and of one a direction, may leave the orbit.
TOLERANCE = 0.05
#: The greatest cosine between detector rows and the axis of rotation: 15 degrees.
TILT = 0.26


@dataclass(frozen=True, eq=False)
class Orbit:
    """Sources on a circle, or parallel beams turned about an axis.

    Args:
        axis: direction of the axis of rotation, a unit vector.
        centre: the isocentre in world mm: the circle's centre; for parallel beams the grid's.
        radius: mm from the axis to the sources (SID); infinite for parallel beams.
        outwards: unit vectors from the axis to the sources, or against the parallel rays.
    """

    axis: Float[Tensor, "3"]
    centre: Float[Tensor, "3"]
    radius: float
    outwards: Float[Tensor, "m 3"]

    @property
    def tangents(self) -> Float[Tensor, "m 3"]:
        """Unit vectors in which the sources move as the angle grows."""
        return torch.linalg.cross(self.axis.expand_as(self.outwards), self.outwards)

    @property
    def angles(self) -> Float[Tensor, " m"]:
        """Each source's angle about the axis in degrees, the first one's being 0."""
        tangent = torch.linalg.cross(self.axis, self.outwards[0])
        return torch.rad2deg(torch.atan2(self.outwards @ tangent, self.outwards @ self.outwards[0]))

    def reach(self, grid: Grid) -> float:
        """The radius in mm about the isocentre of the grid's inscribed cylinder along the axis."""
        steps = grid.affine[:3, :3].to(self.axis)
        along = (unit(steps, dim=0).T @ self.axis).abs().argmax()
        halves = steps.norm(dim=0) * (grid.centre_index.to(steps) + 0.5)
        offset = grid.centre.to(self.axis) - self.centre
        offset = offset - (offset @ self.axis) * self.axis
        return (halves[torch.arange(3) != along].min() + offset.norm()).item()


def orbit_of(cameras: Cameras, grid: Grid) -> Orbit:
    """The circle of a rig's sources, or the turn of its parallel beams, by least squares.

    The plane is that of the singular vectors, the circle that of Kasa's linear fit (IEEE Trans.
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
    look = unit(cameras.origin - cameras.source)
    _, sizes, axes = torch.linalg.svd(look)
    if len(look) < 2 or sizes[1] < 1e-6 * sizes[0]:
        raise ValueError(
            f"FBP needs parallel beams from two directions at least, got {len(look)} views along "
            f"one line"
        )
    axis = axes[2]
    if (leave := (look @ axis).abs().max().item()) > TOLERANCE:
        raise ValueError(
            f"FBP needs parallel beams that are turned about one axis, got directions that leave "
            f"their plane by up to {leave:.2g} of their length, expected at most {TOLERANCE}; "
            f"use sirt"
        )
    outwards = unit(-look + (look @ axis)[:, None] * axis)
    return Orbit(axis, grid.centre.to(axis), torch.inf, outwards)


def _circle(cameras: Cameras) -> Orbit:
    count, mean = len(cameras), cameras.source.mean(dim=0)
    places = cameras.source - mean
    extent = places.norm(dim=1).max()
    places = places / extent if extent > 0 else places  # the same digits in every unit of length
    _, sizes, axes = torch.linalg.svd(places)
    if count < 3 or sizes[1] < 1e-6 * sizes[0] or not sizes[0] > 0:
        raise ValueError(
            f"FDK needs at least three sources on a circle, got {count} on a line; use sirt"
        )
    flat = places @ axes[:2].T
    system = torch.cat([2 * flat, torch.ones_like(flat[:, :1])], dim=1)
    # the normal equations: the last bits of LAPACK's lstsq change with where a tensor lies
    fit = torch.linalg.solve(system.T @ system, system.T @ flat.square().sum(dim=1))
    radius = (fit[2] + fit[:2].square().sum()).sqrt().item()
    out = flat - fit[:2]
    off = torch.hypot(places @ axes[2], out.norm(dim=1) - radius).max().item()
    if not off <= TOLERANCE * radius:
        raise ValueError(
            f"FDK needs sources on a circle, within {TOLERANCE:.0%} of its radius, got {count} "
            f"sources that leave the best circle, of radius {extent * radius:.4g} mm, by up to "
            f"{extent * off:.4g} mm; use sirt"
        )
    centre, radius = mean + extent * (fit[:2] @ axes[:2]), extent.item() * radius
    return Orbit(axes[2], centre, radius, unit(out) @ axes[:2])


def _check_rows(cameras: Cameras, orbit: Orbit) -> None:
    along = (unit(cameras.u) @ orbit.axis).abs()
    if (worst := along.max().item()) > TILT:
        raise ValueError(
            f"The ramp filter runs along detector rows, which must be across the axis of rotation: "
            f"expected a cosine between them of at most {TILT}, got {worst:.2g} in view "
            f"{int(along.argmax())}; if rows run along the axis, exchange rows and columns of "
            f"views and cameras"
        )
