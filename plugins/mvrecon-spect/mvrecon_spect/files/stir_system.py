"""Geometry of STIR's pinhole systems (PinholeSPECTUB).

A detector at the angle t has the axes x' along its rows, y' outwards, z:

    x' = x cos t + y sin t    y' = y cos t - x sin t    t = ang0 + j incr

Its hole is at y' = R_c + y_h, where R_c is the collimator's radius; its plane is y' = radius +
crystal / 2, since the radius in the header is that of the crystal's front. Source: STIR's manual,
Pinhole SPECT UB; the sign of the angle of `cyl` follows the program: x' = (R_c + y_h) sin(a - t).
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor

from mvrecon.geometry.cameras.camera import Cameras
from mvrecon.geometry.cameras.formats.common import from_world, into_world, square_pixels
from mvrecon.geometry.cameras.rigs import Detector
from mvrecon_spect.files.stir_text import CollimatorText, DetectorText, Opening, Ring

#: Tolerance, in mm and for components of unit vectors, of a rig that is exported to STIR.
CLOSE = 1e-6
#: Tolerance in degrees for rounding of pixels on the edge of the acceptance angle.
ROUNDING = 1e-9


@dataclass(frozen=True)
class StirSystem:
    """A pinhole system in STIR's description, in mm and degrees.

    Args:
        shape: pixels of a detector, rows (along z) and columns (along x').
        pixel_mm: pixel size, in the same order.
        radius_mm: distance from the axis to the crystal's front.
        detector, collimator: contents of the two text files.

    Raises:
        ValueError: a hole without a detector, a detector without a hole, a hole behind its
            detector's plane, or a hole as wide as its distance to the plane, which indicates cm
            instead of mm.
    """

    shape: tuple[int, int]
    pixel_mm: tuple[float, float]
    radius_mm: float
    detector: DetectorText
    collimator: CollimatorText

    def __post_init__(self) -> None:
        known = set(range(len(self.angles)))
        if (used := {hole.detector for hole in self.collimator.openings}) != known:
            raise ValueError(
                f"Expected holes for the detectors 1 to {len(known)}, got "
                f"{len(used & known)} of them with a hole and {len(used - known)} others"
            )
        for hole in self.collimator.openings:
            outwards = self.hole_place(hole.detector, hole.place_mm)[1]
            room = self.plane_mm - outwards
            if not (outwards > 0 and room > max(hole.size_mm)):
                raise ValueError(
                    f"Expected a hole between axis and detector, smaller than its way there, got "
                    f"{max(hole.size_mm):g} mm wide at {outwards:g} mm from the axis, the "
                    f"detector's plane at {self.plane_mm:g} mm; the header "
                    f"is in mm, the text files are in cm"
                )

    @property
    def plane_mm(self) -> float:
        """Distance of the detectors' plane from the axis: the centre of the crystal."""
        return self.radius_mm + self.detector.crystal_mm / 2

    @property
    def angles(self) -> list[float]:
        """Angle t of each detector in degrees."""
        return [
            ring.first_degrees + j * ring.step_degrees
            for ring in self.detector.rings
            for j in range(ring.count)
        ]

    @property
    def heights(self) -> list[float]:
        """Axial position of each detector's centre in mm."""
        return [ring.z_mm for ring in self.detector.rings for _ in range(ring.count)]

    @property
    def openings(self) -> list[Opening]:
        """The holes, grouped by detector."""
        return sorted(self.collimator.openings, key=lambda hole: hole.detector)

    @property
    def holes(self) -> int:
        """Number of holes of each detector.

        Raises:
            ValueError: the numbers differ.
        """
        counts = {
            sum(hole.detector == index for hole in self.collimator.openings)
            for index in range(len(self.angles))
        }
        if len(counts) != 1:
            raise ValueError(f"Expected equally many holes on all detectors, got {sorted(counts)}")
        return counts.pop()

    def hole_place(self, detector: int, place_mm: Sequence[float]) -> tuple[float, float, float]:
        """Position (x', y', z) of a hole in its detector's axes in mm, y' measured from the
        axis.
        """
        first, outwards, z = place_mm
        if self.collimator.model == "pol":
            return first, self.collimator.radius_mm + outwards, z
        turn = math.radians(first - self.angles[detector])
        radius = self.collimator.radius_mm + outwards
        return radius * math.sin(turn), radius * math.cos(turn), z


def cameras_of(system: StirSystem, world: str = "RAS") -> Cameras:
    """Pinholes of a system in mm: the holes of the first detector, those of the second, ...

    Rows run along z and columns along x', in the order of STIR's projections, which therefore need
    no flip.

    Args:
        system: the geometry.
        world: axes of the file, see `mvrecon.geometry.cameras.formats.common.to_ras`. STIR's are
            LPS for a patient on the back and RAS for one on the belly, both head first.
    """
    openings = system.openings
    index = [hole.detector for hole in openings]
    angles = torch.deg2rad(torch.tensor(system.angles, dtype=torch.float64)[index])
    heights = torch.tensor(system.heights, dtype=torch.float64)[index]
    axes, zero = _axes(angles), torch.zeros_like(angles)
    places = torch.tensor(
        [system.hole_place(hole.detector, hole.place_mm) for hole in openings], dtype=torch.float64
    )
    middle = torch.stack([zero, zero + system.plane_mm, heights], dim=-1)
    lifted = places + torch.stack([zero, zero, heights], dim=-1)
    detector = Detector(system.shape, system.pixel_mm)
    look = torch.stack([axes[:, 0], axes[:, 2], -axes[:, 1]], dim=1)
    source, centre = (torch.einsum("mi,mix->mx", place, axes) for place in (lifted, middle))
    cameras = detector.carried(source, centre, look, extent="behind")
    return from_world(cameras, world)


def accepted(
    cameras: Cameras, openings: Sequence[Opening], pixel_mm: Sequence[float]
) -> Bool[Tensor, "m v u"]:
    """Pixels of each camera within the acceptance angles of its hole: those of the file by their
    centres, and joined ones whose parts all are.

    Args:
        cameras: cameras of `cameras_of`, with any pixels.
        openings: the hole of each.
        pixel_mm: size of the file's pixels (v, u).
    """
    hole, pixel = cameras.rays()
    within = []
    for axis, along in enumerate((cameras.u, cameras.v)):
        joined = (along.norm(dim=-1) / pixel_mm[1 - axis]).round().clamp_min(1)
        inside = (joined - 1) / (2 * joined)  # from the middle to that of the outermost part
        unit, reach = F.normalize(along, dim=-1), inside * along.norm(dim=-1)
        place = ((pixel - hole) * unit[:, None, None]).sum(dim=-1)
        limits = [(one.axis_degrees[axis], one.acceptance_degrees[axis]) for one in openings]
        tilt, half = place.new_tensor(limits).T[..., None, None]
        for end in (-1, 1):
            edge = place + end * reach[:, None, None]
            angle = torch.atan2(edge, cameras.distance[:, None, None])
            within.append((torch.rad2deg(angle) - tilt).abs() <= half + ROUNDING)
    return torch.stack(within).all(dim=0)


def system_of(
    cameras: Cameras,
    diameter_mm: float,
    crystal_mm: float = 0.0,
    sigma_mm: float = 0.0,
    world: str = "RAS",
) -> StirSystem:
    """Convert a rig of pinholes about the z axis to a STIR system, in mm.

    Args:
        cameras: one pinhole per detector, at equal angular steps; detectors parallel to the z axis
            with rows along it, all at the same distance and height.
        diameter_mm: diameter of the round holes.
        crystal_mm: thickness of the crystal, with the detector plane at its centre.
        sigma_mm: standard deviation of the intrinsic resolution.
        world: axes of the written files.

    Raises:
        ValueError: STIR cannot represent the rig.
    """
    rig = into_world(cameras, world)
    pixel_mm = square_pixels(rig, "STIR")
    angles = torch.atan2(rig.u[:, 1], rig.u[:, 0])
    axes = _axes(angles)
    places, middles = (
        torch.einsum("mix,mx->mi", axes, point) for point in (rig.source, rig.detector_centre)
    )
    degrees = torch.rad2deg(angles)
    steps = (degrees.diff() + 180) % 360 - 180
    steps = steps if len(steps) else torch.ones(1).double()
    off = {
        "steps of the angle": (steps - steps[0]).abs().max(),
        "middles beside x' = 0": middles[:, 0].abs().max(),
        "distances and heights": (middles - middles[0])[:, 1:].abs().max(),
        "directions of v and z": (rig.v / pixel_mm[0] - axes[:, 2]).abs().max(),
        "directions of u and x'": (rig.u / pixel_mm[1] - axes[:, 0]).abs().max(),
    }
    if cameras.extent != "behind" or max(off.values()) > CLOSE:
        worst = max(off, key=lambda name: off[name].item())
        raise ValueError(
            "Expected pinholes about the z axis in equal steps, with detectors parallel to it and "
            f"rows along it, got {cameras.extent!r} cameras whose {worst} differ by "
            f"{off[worst].item():.3g}; STIR has no other"
        )
    radius = places[:, 1].mean().item()
    place = places - places.new_tensor([0.0, radius, middles[0, 2].item()])
    openings = tuple(
        Opening(index, (x, y, z), "round", (diameter_mm, diameter_mm))
        for index, (x, y, z) in enumerate(place.tolist())
    )
    ring = Ring(len(cameras), degrees[0].item(), steps[0].item(), middles[0, 2].item())
    return StirSystem(
        shape=cameras.shape,
        pixel_mm=pixel_mm,
        radius_mm=middles[0, 1].item() - crystal_mm / 2,
        detector=DetectorText(sigma_mm, crystal_mm, 0.0, (ring,)),
        collimator=CollimatorText("pol", radius, 0.0, openings),
    )


def _axes(angles: Float[Tensor, " m"]) -> Float[Tensor, "m 3 3"]:
    """Rows x', y', z of detectors at angles in radians."""
    cosine, sine, zero = angles.cos(), angles.sin(), torch.zeros_like(angles)
    rows = [[cosine, sine, zero], [-sine, cosine, zero], [zero, zero, zero + 1]]
    return torch.stack([torch.stack(row, dim=-1) for row in rows], dim=1)
