"""Scales: tiny and huge voxels, distant origins and sources, flat voxels, coarse and fine pixels,
thin volumes; orientation; orders of convergence in the voxel size.
"""

import itertools
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import lru_cache

import torch
from torch import Tensor
from torch.nn.functional import normalize

from mvrecon.core.parts import PROJECTORS
from mvrecon.data.scenes.solids import Phantom, Solids, voxelise
from mvrecon.geometry.cameras.camera import VECTORS, Cameras
from mvrecon.geometry.grid import Grid
from mvrecon.geometry.rigid import random_rotation
from mvrecon.operators.ray_transform import RAY_METHODS
from mvrecon.testing.measures import gap, greatest, motion_gap
from mvrecon_bench.stresses.analytic import Blob, rows, through
from mvrecon_bench.stresses.case import DIGITS, PRECISE, DoesNotApply, bound, case
from mvrecon_bench.stresses.subject import GRID, ProjectorSubject

#: At a distance of 1e6 mm, float64 resolves 1e-10 mm.
FAR = bound(1e-9, 2e-6)
CENTRE = (3.0, -2.0, 4.0)
#: Sizes of boxes: one voxel, a slice, a row, and prime sizes.
SHAPES = (
    *((1, 1, 1), (1, 5, 6), (6, 1, 5), (5, 6, 1), (9, 1, 1), (1, 9, 1), (1, 1, 9)),
    *((2, 3, 5), (13, 7, 11)),
)
FLAT = ((0.7, 0.7, 5.0), (5.0, 0.7, 0.7), (1e-2, 1.0, 1e2), (1e2, 1e-2, 1.0), (1.0, 1e4, 1.0))
#: A shape without mirror symmetry.
LETTER = torch.tensor([[1, 1, 1], [1, 0, 0], [1, 1, 0], [1, 0, 0], [1, 0, 0]])
#: Grids on which an order of convergence is measured, along each axis, in a box of 48 mm.
GRIDS = (16, 32, 64)
#: Projectors of other libraries that support any rig (plugin mvrecon-peers): Joseph's and Siddon's
#: methods, and sampling.
ORACLES = ("rtk", "diffdrr", "nanodrr")


@case("projector", 12, DIGITS)
def scaled(subject: ProjectorSubject) -> Iterator[float]:
    """Voxels of 1e-6 to 1e6 mm: proportional views."""
    rig, volume = subject.rig(), subject.random(1, 1, *GRID.shape)
    views = subject.projector(GRID, rig)(volume).double()
    for factor in (1e-6, 1e-3, 1e3, 1e6):
        affine = GRID.affine.clone()
        affine[:3] *= factor
        other = replace(rig, **{name: factor * getattr(rig, name) for name in VECTORS})
        found = subject.projector(Grid(GRID.shape, affine), other)(volume)
        yield gap(found.double() / factor, views)


@case("projector", 13, FAR)
def far_away(subject: ProjectorSubject) -> float:
    """Rig and volume 1 to 1e6 mm from the origin: the same views."""
    rig, volume = subject.rig(), subject.random(1, 1, *GRID.shape)
    way, still = torch.tensor([1.0, -0.7, 0.3], dtype=torch.float64), torch.eye(3)
    return greatest(
        motion_gap(subject.projector, GRID, rig, volume, still, mm * way)
        for mm in (1.0, 1e2, 1e4, 1e5, 1e6)
    )


@case("projector", 14, DIGITS)
def far_source(subject: ProjectorSubject) -> Iterator[float]:
    """A source 1e2 to 1e7 mm away: parallel rays in the limit."""
    subject.need_lines()
    yield 0.0
    grid, volume, plane, points = _smooth(subject)
    look = torch.linalg.cross(plane[1], plane[2])
    look = normalize(look, dim=0)
    limit = subject.values(grid, points - 8 * look, points + 8 * look, volume)
    for distance in (1e2, 1e3, 1e5, 1e7):
        rig = _facing(subject, plane, (5, 5), distance, 1 + 8 / distance)
        found = subject.projector(grid, rig)(volume[None, None]).flatten()
        yield gap(found, limit) - 20 / distance


@case("projector", 14, FAR)
def magnified(subject: ProjectorSubject) -> Iterator[float]:
    """Magnification of 1.0001 to 50: equal to single rays."""
    subject.need_lines()
    if subject.beam[0]:
        raise DoesNotApply("parallel rays magnify nothing")
    grid, volume, plane, points = _smooth(subject)
    look = normalize(torch.linalg.cross(plane[1], plane[2]), dim=0)
    for k in (1.0001, 1.01, 1.5, 5.0, 50.0):
        distance = max(12.0, 8 / (k - 1))
        rig = _facing(subject, plane, (5, 5), distance, k)
        source = (points.mean(dim=0) - distance * look).expand_as(points)
        alone = subject.values(grid, source, source + 3 * (points - source), volume)
        yield gap(subject.projector(grid, rig)(volume[None, None]).flatten(), alone)


@case("projector", 15, PRECISE)
def anisotropic(subject: ProjectorSubject) -> float:
    """Voxels 7 and 1e4 times as long as wide: chords of a box of ones."""
    subject.need_exact()
    grids = (Grid.centred(size=(7, 6, 5), spacing=mm, centre=CENTRE) for mm in FLAT)
    return greatest(_chords(subject, grid) for grid in grids)


@case("projector", 16, 1e-2)
def coarse_and_fine(subject: ProjectorSubject) -> Iterator[float]:
    """Pixels of 9 and of 1/40 voxels: the mean of a blob in every view."""
    subject.need_lines()
    grid = Grid.centred((48, 48, 48), 1.0, CENTRE)
    blob = Blob(grid.centre + torch.tensor([0.3, -0.2, 0.4]), 7.0)
    volume = blob.values(grid).to(subject.device, subject.dtype)[None, None]
    for mm in (1.2, 0.003):
        rig = subject.rig(grid, {"pixels": [6, 5], "pixel_mm": mm}, n_views=7)
        views = subject.projector(grid, rig)(volume)[0, 0].double().cpu()
        lost = (views.amax(dim=(1, 2)) == 0).sum()
        off = (views.mean() / blob.integrals(*rig.rays()).mean() - 1).abs()
        yield float(lost)
        yield float(off)


@case("projector", 17, DIGITS)
def thin(subject: ProjectorSubject) -> Iterator[float]:
    """Volumes of one voxel, slice or row: chords, and sums of rows."""
    subject.need_exact()
    for shape in SHAPES:
        grid = Grid.centred(size=shape[::-1], spacing=(0.9, 1.2, 1.0), centre=CENTRE)
        volume = subject.random(*shape)
        start, end, sums = rows(grid, volume)
        yield gap(subject.values(grid, start, end, volume), sums)
        yield _chords(subject, grid)


@case("projector", 20)
def letter(subject: ProjectorSubject) -> Iterator[float]:
    """The letter F from six sides, each way up: upright in every view."""
    subject.need("pixelwise")
    axes_of = torch.cat([torch.eye(3), -torch.eye(3)]).double()
    for right, down in itertools.permutations(axes_of, 2):
        if (right * down).any():
            continue
        way = torch.stack([torch.linalg.cross(right, down), down, right])
        axes, signs = way.abs().argmax(dim=1).tolist(), way.sum(dim=1).tolist()
        mirrored = [i for i in range(3) if signs[i] < 0]
        slices = torch.stack([torch.zeros_like(LETTER), LETTER]).flip(mirrored)
        volume = slices.permute([axes.index(axis) for axis in (2, 1, 0)])
        grid = Grid.centred(size=volume.shape[::-1], spacing=(0.9, 1.2, 1.0), centre=CENTRE)
        u, v = grid.spacing[axes[2]] * right, grid.spacing[axes[1]] * down
        rig = _facing(subject, (grid.centre - u - 2 * v, u, v), (5, 3), 1e5, 1.5)
        x = volume.to(subject.device, subject.dtype)[None, None]
        image = subject.projector(grid, rig)(x)[0, 0, 0].cpu()
        yield float((~((image / image.max() - LETTER).abs() <= 1e-3)).sum())


@case("projector", 31)
def smooth(subject: ProjectorSubject) -> float:
    """A smooth blob on three grids: error falls by the stated order."""
    blob = Blob(torch.tensor([1.3, -0.7, 0.4], dtype=torch.float64), 5.0)
    order = _order(subject, blob.values, lambda rig: blob.integrals(*rig.rays()))
    return (0.9 if subject.of_cells else 1.8) - order


@case("projector", 31)
def sharp(subject: ProjectorSubject) -> float:
    """Solids with edges on three grids: error falls by the stated order."""
    return 0.9 - _order(subject, lambda grid: _voxels(grid.shape[0]), _solids().views)


@case("projector", 32, 1e-3)
def oracles(subject: ProjectorSubject) -> float:
    """A blob, compared with other libraries: equal views of at least one library, or of mvrecon
    for a plugin.
    """
    subject.need_lines()
    grid = Grid.centred((49, 49, 49), 1.0, CENTRE)
    detector = {"pixels": [9, 11], "pixel_mm": [0.9, 0.8], "offset_mm": [0.04, -0.03]}
    rig = subject.rig(grid, detector)
    volume = Blob(grid.centre + 0.4, 5.5).values(grid).to(subject.device, subject.dtype)[None, None]
    views, gaps = subject.projector(grid, rig)(volume), []
    others = [{"name": name} for name in set(ORACLES) & set(PROJECTORS.names()) - {subject.name}]
    if not subject.ours:
        own = "radon" if rig.parallel else "drr"
        others += [{"name": own, "method": method} for method in RAY_METHODS]
    for other in others:
        try:
            B = PROJECTORS.from_config(other, grid=grid, cameras=rig)
            gaps.append(gap(views, B(volume.cpu())))
        except (ImportError, ValueError):  # not installed, or the rig is not supported
            continue
    if not gaps:
        raise DoesNotApply(
            "no other library's projector is installed that takes this rig; see mvrecon-peers"
        )
    return min(gaps)


def _chords(subject: ProjectorSubject, grid: Grid) -> float:
    """The relative error of a box of ones."""
    start, end, lengths = through(grid)
    return float((subject.values(grid, start, end) / lengths - 1).abs().max())


def _smooth(
    subject: ProjectorSubject,
) -> tuple[Grid, Tensor, tuple[Tensor, Tensor, Tensor], Tensor]:
    """A blob that decays within its grid, and a plane of 5 x 5 points (corner, steps along its
    columns and rows, points row by row) through it in a generic pose.
    """
    grid = Grid.centred(size=(14, 15, 16), spacing=(0.4, 0.45, 0.5))
    blob = Blob(torch.tensor([0.3, -0.2, 0.4], dtype=torch.float64), 1.5)
    right, down, _ = random_rotation(torch.Generator().manual_seed(5))
    corner, u, v = -2.2 * right - 2.4 * down, 1.1 * right, 1.2 * down
    steps = torch.cartesian_prod(*[torch.arange(5, dtype=torch.float64)] * 2)
    points = corner + steps @ torch.stack([v, u])
    return grid, blob.values(grid).to(subject.device, subject.dtype), (corner, u, v), points


def _facing(
    subject: ProjectorSubject,
    plane: Sequence[Tensor],
    shape: tuple[int, int],
    distance: float,
    k: float,
) -> Cameras:
    """A camera perpendicular to a plane, whose pixel (row, column) sees the point corner + column u
    + row v.

    Central cameras are at the given distance from the plane's centre with detectors at k times that
    distance, or equally far behind a pinhole; parallel rays start and end 8 mm in front of and
    behind the plane.
    """
    (corner, u, v), (parallel, extent) = plane, subject.beam
    look = normalize(torch.linalg.cross(u, v), dim=0)
    if parallel:
        source, origin, k = corner - 8 * look, corner + 8 * look, 1.0
    else:
        source = corner + (shape[1] - 1) / 2 * u + (shape[0] - 1) / 2 * v - distance * look
        k = -k if extent == "behind" else k
        origin = source + k * (corner - source)
    return Cameras(source[None], origin[None], k * u[None], k * v[None], shape, parallel, extent)


def _order(
    subject: ProjectorSubject, volume: Callable[[Grid], Tensor], truth: Callable[[Cameras], Tensor]
) -> float:
    """Slope of the error over three grids, from finest to coarsest."""
    subject.need_lines()
    detector = {"pixels": [20, 21], "pixel_mm": [0.31, 0.33], "offset_mm": [0.03, 0.05]}
    rig = subject.rig(_box(GRIDS[0]), detector, n_views=4)
    turn = random_rotation(torch.Generator().manual_seed(0))
    rig, errors = rig.moved(turn, torch.zeros(3)), []  # otherwise rows would coincide with slices
    for n in GRIDS:
        x = volume(_box(n)).to(subject.device, subject.dtype)[None, None]
        errors.append(gap(subject.projector(_box(n), rig)(x)[0, 0], truth(rig)))
    return float(torch.tensor(errors[0] / errors[-1]).log2()) / (len(errors) - 1)


def _box(n: int) -> Grid:
    """Voxels of 48 / n mm, a third longer along z."""
    return Grid.centred((n, n, n), (48 / n, 48 / n, 64 / n))


def _solids() -> Phantom:
    rng, one = torch.Generator().manual_seed(5), torch.ones(1)
    places = [[1.0, -2.0, 4.5], [-9.0, 6.0, -12.0], [8.0, 5.0, -10.0]]
    axes = [[13.0, 16.0, 11.0], [6.0, 7.0, 9.0], [7.0, 5.0, 8.0]]
    sizes = torch.tensor([places, axes], dtype=torch.float64).unbind()
    kinds = zip(("ellipsoid", "cylinder", "box"), *sizes, strict=True)
    return Phantom(
        tuple(Solids(kind, p[None], random_rotation(rng, 1), a[None], one) for kind, p, a in kinds)
    )


@lru_cache(maxsize=8)
def _voxels(n: int) -> Tensor:
    return voxelise(_solids(), _box(n))
