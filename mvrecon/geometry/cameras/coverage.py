"""How much of a grid a rig sees, and the detector that sees all of it."""

import math
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import adaptive_avg_pool3d

from mvrecon.core.parts import CAMERAS, CameraPart, Options
from mvrecon.geometry.cameras.camera import Cameras
from mvrecon.geometry.cameras.field import resolution, sees
from mvrecon.geometry.grid import Grid, voxel_centres
from mvrecon.geometry.lattice import centred_affine
from mvrecon.geometry.rigid import unit

#: Most blocks of voxels along an axis, whose centres are tested; fewer, but no fewer than the
#: second number, where all blocks in all views would be more than the third.
MAX_BLOCKS, MIN_BLOCKS, MAX_TESTS = 32, 8, 4_000_000
#: Points of a cylinder's rim.
RIM_POINTS = 64
#: A point is poorly seen by fewer views than this share of those that see the best seen point: less
#: than half, so that a half fan, which sees its outer field in half of the views, is a good scan.
MIN_SEEN_SHARE = 0.4
#: Share of the grid's inscribed ellipsoid, or of a body, that may be poorly seen without a warning.
MAX_POOR_SHARE = 0.05
#: Largest distance of rays from the middle of a single slice, as a share of its thickness, without
#: a warning.
MAX_ASIDE = 0.1
#: The value of a detector's `pixels` or `pixel_mm` that fits it to the grid.
FIT = "fit"


class Coverage(NamedTuple):
    """Shares of a grid's voxels or of bodies' mass, from 0 to 1, that a rig sees.

    Args:
        every: share of the grid that every view sees.
        half: share that at least half of the views see.
        none: share that no view sees.
        poor: share seen by less than `MIN_SEEN_SHARE` of the views that see the best seen point.
    """

    every: float
    half: float
    none: float
    poor: float

    def __str__(self) -> str:
        return (
            f"{self.every:.1%} seen by all views, {self.half:.1%} by at least half, "
            f"{self.none:.1%} by none"
        )


@torch.no_grad()
def coverage(
    cameras: Cameras, grid: Grid, weights: Float[Tensor, "d h w"] | None = None
) -> Coverage:
    """Return the shares of a grid that all, at least half, and none of the views see.

    Counts the centres of blocks of voxels, 32 or fewer along each axis, in every view.

    Args:
        cameras: the rig.
        grid: grid of the voxels.
        weights: non-negative, of each voxel, such as a body's attenuation; None: all are equal.
            Shares of a zero volume are NaN.

    Returns:
        The shares, from 0 to 1, as a `Coverage`.

    Examples:
        >>> rig = mv.circular(8, sid=200, sdd=300, detector={"pixels": [16, 16], "pixel_mm": 3.0})
        >>> mv.coverage(rig, mv.Grid.centred(16, spacing=1.0)).every  # a field of 32 mm
        1.0
        >>> mv.coverage(rig, mv.Grid.centred(16, spacing=4.0)).every < 0.3
        True
    """
    seen = _seen(cameras, grid)
    return _shares(seen, torch.ones_like(seen) if weights is None else _pooled(weights, seen))


def _shares(seen: Float[Tensor, "d h w"], weights: Float[Tensor, "d h w"]) -> Coverage:
    """The shares of weighted blocks, from the share of the views that see each."""
    most = seen.max().item()
    poor = seen < MIN_SEEN_SHARE * most if most else seen == 0
    masks = (seen == 1, seen >= 0.5, seen == 0, poor)
    return Coverage(*(((weights * mask).sum() / weights.sum()).item() for mask in masks))


def _pooled(volume: Float[Tensor, "d h w"], seen: Tensor) -> Float[Tensor, "d h w"]:
    """The positive part of a volume in the blocks of `seen`."""
    d, h, w = seen.shape
    return adaptive_avg_pool3d(volume[None].cpu().double().clamp(min=0), (d, h, w))[0]


def _seen(cameras: Cameras, grid: Grid) -> Float[Tensor, "d h w"]:
    """The share of the views that see the centre of each block."""
    most = min(MAX_BLOCKS, max(MIN_BLOCKS, int((MAX_TESTS / len(cameras)) ** (1 / 3))))
    shape, rig = [min(most, n) for n in grid.shape], cameras.to("cpu")
    flat = voxel_centres(grid.divided(shape[::-1])).reshape(-1, 3)
    counts = torch.zeros(len(flat), dtype=torch.float64)
    for view in rig:
        counts += sees(view, flat)[0]
    return (counts / len(rig)).reshape(shape)


def _inscribed(shape: Sequence[int]) -> Bool[Tensor, "d h w"]:
    """The blocks whose centres lie in the ellipsoid that touches the grid's faces."""
    squares = [torch.linspace(-1 + 1 / n, 1 - 1 / n, n).square() for n in shape]
    z, y, x = torch.meshgrid(*squares, indexing="ij")
    return x + y + z <= 1


@torch.no_grad()
def covering_pixels(cameras: Cameras, grid: Grid) -> tuple[float, float]:
    """Return the least number of rows and columns, as fractions, with which every detector about
    its present centre sees the grid's inscribed cylinder along z, in pixels of the present pitch.

    A grid of one slice needs a fan beam: its rim counts in its plane alone, and its thickness on
    its axis, since the part of the rim nearest to a source would need a second row.

    Raises:
        ValueError: a source within the cylinder, or behind which a part of it lies.
    """
    rig = cameras.to("cpu")
    angle = 2 * math.pi * torch.arange(RIM_POINTS, dtype=torch.float64) / RIM_POINTS
    outside = 1 / math.cos(math.pi / RIM_POINTS)  # the polygon encloses the circle
    x, y = (outside * f(angle) for f in (torch.cos, torch.sin))
    rims = torch.cat([torch.stack([x, y, torch.full_like(x, end)], dim=-1) for end in (-1, 1)])
    if grid.shape[0] == 1:
        parts = rims.new_tensor([[1.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
        rims = (rims * parts[:, None]).flatten(0, 1)
    affine = centred_affine(grid)
    half = torch.tensor(grid.size, dtype=torch.float64) / 2
    uvz = rig.project((rims * half) @ affine[:3, :3].T + affine[:3, 3])
    if not rig.valid(uvz).all():
        view = int((~rig.valid(uvz)).any(dim=1).nonzero()[0, 0])
        raise ValueError(
            f"No detector of this rig sees the whole grid of {_box(grid)} mm: a part of its "
            f"inscribed cylinder lies behind the source or the detector of view {view}; increase "
            f"the distances, or take a smaller grid"
        )
    rows, columns = rig.shape
    centre = uvz.new_tensor([(columns - 1) / 2, (rows - 1) / 2])
    u, v = (2 * (uvz[..., :2] - centre).abs().amax(dim=(0, 1))).tolist()
    return v, u


def fit_detector(cameras: Cameras, grid: Grid) -> Cameras:
    """Return a rig whose detectors, with as many pixels about the same centres, have the pitch with
    which every view sees the grid's inscribed cylinder along z.

    Of settings, `camera.detector.pixel_mm=fit`; see `fitted`.

    Returns:
        The rig with other pixel steps u and v, and first pixels.

    Raises:
        ValueError: see `covering_pixels`.

    Examples:
        >>> rig = mv.circular(8, sid=200, sdd=300, detector={"pixels": [16, 16], "pixel_mm": 3.0})
        >>> wide = mv.fit_detector(rig, mv.Grid.centred(16, spacing=4.0))
        >>> wide.shape, wide.u.norm(dim=1).min() > 6  # mm
        ((16, 16), tensor(True))
    """
    rows, columns = cameras.shape
    v, u = covering_pixels(cameras, grid)
    factor = max(v / rows, u / columns)
    shift = ((columns - 1) * cameras.u + (rows - 1) * cameras.v) * (1 - factor) / 2
    source = cameras.source + shift if cameras.parallel else cameras.source
    return replace(
        cameras,
        source=source,
        origin=cameras.origin + shift,
        u=factor * cameras.u,
        v=factor * cameras.v,
    )


def fitted(camera: CameraPart, grid: Options) -> CameraPart:
    """Return a camera's settings with numbers in place of `fit`, with which every view sees the
    grid's inscribed cylinder along z.

    `pixel_mm: fit` of a detector is the pitch of its pixels, square, rounded up to three digits;
    `pixels: fit` the number of rows and of columns of its pitch; both, or `detector: fit`, pixels
    as wide as a voxel seen at the grid's centre.

    Args:
        camera: name and options.
        grid: options of `Grid.centred`.

    Raises:
        ValueError: no detector of the camera sees that cylinder, see `covering_pixels`; or the
            detector's position depends on its pixels.
    """
    given = camera.get("detector")
    detector: Any = dict.fromkeys(("pixels", "pixel_mm"), FIT) if given == FIT else given
    if not isinstance(detector, Mapping):
        return dict(camera)
    wanted = [name for name in ("pixels", "pixel_mm") if detector.get(name) == FIT]
    if not wanted:
        return dict(camera)
    box = Grid.centred(**grid)

    def rig(**changes: Any) -> Cameras:
        return CAMERAS.from_config({**camera, "detector": {**detector, **changes}})

    one, two = (rig(pixels=n, pixel_mm=float(n)).detector_centre for n in (1, 2))
    if not torch.allclose(one, two):  # as of matrices, whose pixels have their places already
        raise ValueError(
            f"expected numbers for {' and '.join(wanted)} of the detector of the camera "
            f"{camera['name']!r}, on which its position depends, got {FIT}"
        )
    if len(wanted) == 2:
        unit_pitch = resolution(rig(pixels=1, pixel_mm=1.0), box.centre)
        detector = {**detector, "pixel_mm": _rounded_up(min(box.spacing) / unit_pitch)}
    if "pixels" in wanted:
        needed = covering_pixels(rig(pixels=1), box)
        detector = {**detector, "pixels": [math.ceil(n - 1e-6) for n in needed]}
    else:
        trial = rig(pixel_mm=1.0)
        ratios = zip(covering_pixels(trial, box), trial.shape, strict=True)
        detector = {**detector, "pixel_mm": _rounded_up(max(need / n for need, n in ratios))}
    return {**camera, "detector": detector}


def _rounded_up(value: float) -> float:
    """A positive number rounded up to three digits."""
    step = 10.0 ** (math.floor(math.log10(value)) - 2)
    return float(f"{math.ceil(value / step - 1e-9) * step:.6g}")


def check_coverage(
    cameras: Cameras,
    grid: Grid,
    remedy: str | None = None,
    bodies: Sequence[Float[Tensor, "d h w"]] = (),
) -> None:
    """Warn of a rig that sees little of the grid, or of the bodies in it.

    The grid is judged by its inscribed ellipsoid, as its corners lie outside the field of most
    rigs; bodies by their mass, which is the sum over their voxels.

    Args:
        cameras: the rig.
        grid: the voxels.
        remedy: advice that ends the warning; None: how to choose the detector, if there is one.
        bodies: true volumes of the first cases.

    Warns:
        UserWarning: more than `MAX_POOR_SHARE` of the ellipsoid or of the bodies is poorly seen;
            gives the shares of the grid and of the bodies, and a detector that would do. Rays pass
            beside the middle of a grid of one slice.
    """
    _warn_of_rays_aside(cameras, grid)
    seen = _seen(cameras, grid)
    judged = [_shares(seen, _inscribed(seen.shape).to(seen))]
    whole = _shares(seen, torch.ones_like(seen))
    words = f"The rig sees little of the grid of {_box(grid)} mm: {whole}"
    mass = sum((_pooled(body, seen) for body in bodies), torch.zeros_like(seen))
    if mass.any():
        judged.append(_shares(seen, mass))
        words += f"; of the mass of the first {len(bodies)} case(s), {judged[-1]}"
    if not any(share.poor > MAX_POOR_SHARE for share in judged):
        return
    warnings.warn(f"{words}. {_advice(cameras, grid, remedy)}", stacklevel=2)


def _warn_of_rays_aside(cameras: Cameras, grid: Grid) -> None:
    """Warn if the rays nearest to the centre of a grid of one slice pass beside its middle: linear
    interpolation between voxels gives them a part of the slice, and iterative methods read its
    values high by as much.
    """
    rows, columns = cameras.shape
    centre = grid.centre.to(cameras.origin)
    last = torch.tensor([columns - 1, rows - 1]).to(centre)
    u, v = cameras.project(centre[None])[:, 0, :2].round().clamp_min(0).minimum(last).mT[..., None]
    pixel = cameras.origin + u * cameras.u + v * cameras.v
    way = unit(cameras.origin - cameras.source if cameras.parallel else pixel - cameras.source)
    aside = pixel - centre
    aside = aside - (aside * way).sum(dim=1, keepdim=True) * way
    for axis in (k for k, count in enumerate(grid.size) if count == 1):
        step = grid.affine[:3, axis].to(centre)
        part = (aside @ step / step.square().sum()).median().item()
        if abs(part) > MAX_ASIDE:
            place = (centre + part * step).tolist()
            warnings.warn(
                f"The rays nearest to the centre of the grid's one slice pass {abs(part):.2g} of "
                f"its thickness beside the middle: iterative methods read values up to "
                f"{1 / max(1 - abs(part), 0.1):.2g} times as high. Choose the centre "
                f"{[round(x, 4) for x in place]} (grid.centre), or several slices",
                stacklevel=3,
            )


def _advice(cameras: Cameras, grid: Grid, remedy: str | None) -> str:
    """The detector that sees the grid's inscribed cylinder, in words, or that none does; and a
    remedy.
    """
    rows, columns = cameras.shape
    try:
        v, u = covering_pixels(cameras, grid)
    except ValueError as error:
        return f"{error}; {remedy}" if remedy else str(error)
    factor = max(v / rows, u / columns)
    pitch = [step.norm(dim=-1).median().item() for step in (cameras.v, cameras.u)]
    mm = " x ".join(f"{_rounded_up(factor * step):g}" for step in pitch)
    return (
        f"Its inscribed cylinder needs a detector of {math.ceil(v)} x {math.ceil(u)} pixels (rows "
        f"x columns) at this pitch, or {rows} x {columns} pixels of {mm} mm; "
        + (remedy or "camera.detector.pixels=fit or camera.detector.pixel_mm=fit chooses it")
    )


def _box(grid: Grid) -> str:
    return " x ".join(f"{n * step:.4g}" for n, step in zip(grid.size, grid.spacing, strict=True))
