"""Random rigs for training on any geometry, and fixed or random misalignments of a rig: shifted and
tilted detectors, shifted sources.
"""

from collections.abc import Sequence
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from mvrecon.core.numbers import generator, uniform
from mvrecon.core.quantities import NonNegativeInt, Pair, PositiveFloat, PositiveInt
from mvrecon.geometry.cameras.camera import Cameras
from mvrecon.geometry.cameras.rigs import Detector, arc, circular, dome
from mvrecon.geometry.rigid import look_at, rotation_by, unit


class Misalignment(NamedTuple):
    """The misalignment of each view of a rig, in the detector's axes.

    Args:
        offset_px: shift of the detector along its columns' and its rows' direction (u, v), in
            pixels.
        tilt_degrees: rotation vector of the detector about its centre, about u, v and the beam (u
            towards v).
        source_mm: shift of the source along u, v and the beam; zero for parallel beams.
        depth_mm: shift of the detector along the beam.
    """

    offset_px: Float[Tensor, "#m 2"]
    tilt_degrees: Float[Tensor, "#m 3"]
    source_mm: Float[Tensor, "#m 3"]
    depth_mm: Float[Tensor, "#m 1"]

    @classmethod
    def none(cls, views: int) -> "Misalignment":
        """Zero misalignment, in float64."""
        return cls(*torch.zeros(views, 9, dtype=torch.float64).split((2, 3, 3, 1), dim=-1))


def misaligned(cameras: Cameras, by: Misalignment) -> Cameras:
    """Apply a misalignment in pixels, degrees and mm to cameras; differentiable in it.

    The detector rotates about its centre, then shifts along its old axes. Parallel rays keep their
    direction and follow the pixels.

    Raises:
        ValueError: a shift of the source of parallel beams, which have none.
    """
    if cameras.parallel and by.source_mm.any():
        raise ValueError(
            f"expected source_mm of zero for parallel beams, which have no source, got up to "
            f"{by.source_mm.abs().max():g} mm"
        )
    rows, columns = cameras.shape
    right, down = unit(cameras.u), unit(cameras.v)
    axes = torch.stack([right, down, unit(torch.linalg.cross(cameras.u, cameras.v))], dim=1)
    turn = axes.mT @ rotation_by(torch.deg2rad(by.tilt_degrees)) @ torch.linalg.inv(axes.mT)
    u, v = ((turn @ step[..., None])[..., 0] for step in (cameras.u, cameras.v))
    shift = by.offset_px[:, :1] * cameras.u + by.offset_px[:, 1:] * cameras.v
    centre = cameras.detector_centre + shift + by.depth_mm * axes[:, 2]
    origin = centre - u * (columns - 1) / 2 - v * (rows - 1) / 2
    source = cameras.source + (axes.mT @ by.source_mm[..., None])[..., 0]
    if cameras.parallel:
        source = origin + cameras.source - cameras.origin
    return Cameras(source, origin, u, v, cameras.shape, cameras.parallel, cameras.extent)


def perturbed(
    cameras: Cameras,
    offset_px: float = 2.0,
    tilt_degrees: float = 1.0,
    source_mm: float = 1.0,
    seed: int = 0,
) -> Cameras:
    """Apply a random misalignment to each view: detector offsets in pixels, tilts in degrees and
    source shifts in mm.

    Args:
        cameras: the ideal rig.
        offset_px, tilt_degrees, source_mm: standard deviation along or about each axis.
        seed: seed of the random numbers.

    Raises:
        ValueError: as `misaligned`; parallel beams take `source_mm=0`.
    """
    rng = torch.Generator().manual_seed(seed)
    noise = torch.randn(len(cameras), 8, generator=rng, dtype=torch.float64)
    offset, tilt, source = noise.split((2, 3, 3), dim=-1)
    still = torch.zeros(len(cameras), 1, dtype=torch.float64)
    by = Misalignment(offset_px * offset, tilt_degrees * tilt, source_mm * source, still)
    return misaligned(cameras, by)


#: Kinds of rig: a full circle, an arc, a dome about +z, random directions.
PATHS = ("circle", "arc", "dome", "scattered")
#: Degrees of an arc, full opening of a dome, greatest elevation of scattered cameras.
ARC_DEGREES, APERTURE_DEGREES, MAX_ELEVATION_DEGREES = (90.0, 200.0), (90.0, 180.0), 45.0
#: Greatest relative deviation of a scattered camera's distance.
MAX_DISTANCE_DEVIATION = 0.2


def random_rig(
    n_views: Pair[PositiveInt],
    sid: Pair[PositiveFloat],
    magnification: Pair[PositiveFloat],
    pixels: Pair[PositiveInt],
    field_mm: Pair[PositiveFloat],
    paths: Sequence[str] = PATHS,
    seed: NonNegativeInt = 0,
) -> Cameras:
    """Draw cone-beam cameras about the origin, in mm, on a random path with random distances and
    detector.

    Each pair gives the range of a uniform draw.

    Args:
        n_views: number of cameras.
        sid: mm from the source to the origin.
        magnification: distance from source to detector, relative to `sid`.
        pixels: number of detector rows and of columns, one draw for each.
        field_mm: (v, u), extent of the detector demagnified to the origin.
        paths: kinds of rig, of `PATHS`: cameras on a full "circle" about z, on an "arc" of 90 to
            200 degrees, on a "dome" about +z that opens 90 to 180 degrees, or "scattered" over all
            azimuths and elevations up to 45 degrees, at distances that differ by up to a fifth.
        seed: seed of the draws.

    Returns:
        A rig; the same for the same seed.

    Raises:
        ValueError: a pair that is descending or not positive, no path or an unknown one.

    Examples:
        >>> ranges = {"n_views": (8, 16), "sid": (150.0, 250.0), "magnification": (1.3, 1.6)}
        >>> rig = mv.random_rig(**ranges, pixels=(24, 32), field_mm=(60.0, 80.0), seed=3)
        >>> len(rig), rig.shape
        (14, (29, 29))
    """
    _check(n_views=n_views, sid=sid, pixels=pixels, field_mm=(min(field_mm), max(field_mm)))
    _check(magnification=magnification)
    if not 1 < magnification[0]:
        raise ValueError(f"Expected a magnification above 1, got {list(magnification)}")
    if not paths or not set(paths) <= set(PATHS):
        raise ValueError(f"Expected paths of {', '.join(PATHS)}, got {list(paths)}")
    rng = generator(seed, 0)
    count, rows, columns = (_whole(rng, pair) for pair in (n_views, pixels, pixels))
    path = paths[_whole(rng, (0, len(paths) - 1))]
    distance, ratio = uniform(rng, *sid), uniform(rng, *magnification)
    pitch = [size * ratio / n for size, n in zip(field_mm, (rows, columns), strict=True)]
    detector = {"pixels": [rows, columns], "pixel_mm": pitch}
    start = uniform(rng, 0.0, 360.0)
    if path == "circle":
        return circular(count, distance, distance * ratio, detector, start_degrees=start)
    if path == "arc":
        span = uniform(rng, *ARC_DEGREES)
        return arc(count, distance, distance * ratio, detector, span, start_degrees=start)
    if path == "dome":
        aperture, focal = uniform(rng, *APERTURE_DEGREES), distance * ratio
        return dome(count, distance, focal, aperture, detector, extent="segment")
    return _scattered(rng, count, distance, ratio, Detector.of(detector))


def _scattered(
    rng: torch.Generator, count: int, distance: float, ratio: float, detector: Detector
) -> Cameras:
    """Cameras at random distances in random directions, uniform over the zone of the sphere between
    the elevations, all aimed at the origin.
    """
    azimuth, share = torch.rand(2, count, generator=rng, dtype=torch.float64)
    highest = torch.tensor(MAX_ELEVATION_DEGREES, dtype=torch.float64)
    height = (2 * share - 1) * torch.deg2rad(highest).sin()
    across, azimuth = (1 - height**2).sqrt(), 2 * torch.pi * azimuth
    outwards = torch.stack([across * azimuth.cos(), across * azimuth.sin(), height], dim=-1)
    off = torch.rand(count, 1, generator=rng, dtype=torch.float64)
    source = distance * (1 + MAX_DISTANCE_DEVIATION * (2 * off - 1)) * outwards
    R = look_at(source, torch.zeros_like(source))
    return detector.carried(source, (1 - ratio) * source, R)


def _whole(rng: torch.Generator, pair: Sequence[int]) -> int:
    """A whole number from the first to the second, inclusive."""
    return int(torch.randint(pair[0], pair[1] + 1, (), generator=rng))


def _check(**pairs: Sequence[float]) -> None:
    for name, pair in pairs.items():
        if len(pair) != 2 or not 0 < pair[0] <= pair[1] < float("inf"):
            raise ValueError(
                f"Expected {name} as a pair (least, greatest) of positive numbers, got {list(pair)}"
            )
