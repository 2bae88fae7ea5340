"""Scales: tiny and huge voxels, distant origins and sources, flat voxels, coarse and fine pixels,
thin volumes; orientation.
"""

import itertools
from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from mvrecon.geometry.cameras.camera import VECTORS, Cameras
from mvrecon.geometry.grid import Grid
from mvrecon.geometry.rigid import random_rotation
from mvrecon.testing.measures import gap, greatest
from mvrecon_bench.stresses.analytic import Blob, rows, through
from mvrecon_bench.stresses.case import PRECISE, Case, DoesNotApply
from mvrecon_bench.stresses.subject import GRID, ProjectorSubject, Subject

#: Error of float32 if geometry is computed in float64, relative to the volume, before it is cast.
DIGITS = {torch.float64: 1e-12, torch.float32: 2e-6}
#: At a distance of 1e6 mm, float64 resolves 1e-10 mm.
FAR = {torch.float64: 1e-9, torch.float32: 2e-6}
#: Sizes of boxes: one voxel, a slice, a row, and prime sizes.
SHAPES = (
    (1, 1, 1),
    (1, 5, 6),
    (6, 1, 5),
    (5, 6, 1),
    (9, 1, 1),
    (1, 9, 1),
    (1, 1, 9),
    (2, 3, 5),
    (13, 7, 11),
)
#: A shape without mirror symmetry.
LETTER = torch.tensor([[1, 1, 1], [1, 0, 0], [1, 1, 0], [1, 0, 0], [1, 0, 0]])


def scaled(subject: ProjectorSubject) -> float:
    """Voxels of 1e-6 to 1e6 mm, with the entire geometry in proportion."""
    rig, volume = subject.rig(), subject.random(1, 1, *GRID.shape)
    views, worst = subject.projector(GRID, rig)(volume).double(), 0.0
    for factor in (1e-6, 1e-3, 1e3, 1e6):
        affine = GRID.affine.clone()
        affine[:3] *= factor
        other = replace(rig, **{name: factor * getattr(rig, name) for name in VECTORS})
        scaled_views = subject.projector(Grid(GRID.shape, affine), other)(volume)
        worst = greatest([worst, gap(scaled_views.double() / factor, views)])
    return worst


def far_away(subject: ProjectorSubject) -> float:
    """Volume and cameras up to 1e6 mm from the world origin."""
    rig, volume = subject.rig(), subject.random(1, 1, *GRID.shape)
    views, worst = subject.projector(GRID, rig)(volume), 0.0
    for distance in (1.0, 1e2, 1e4, 1e5, 1e6):
        shift = distance * torch.tensor([1.0, -0.7, 0.3], dtype=torch.float64)
        unturned = torch.eye(3)
        A = subject.projector(GRID.moved(unturned, shift), rig.moved(unturned, shift))
        moved_views = A(volume)
        worst = greatest([worst, gap(moved_views, views)])
    return worst


def far_source(subject: ProjectorSubject) -> float:
    """Sources at a distance of 1e2 to 1e7 mm: deviation from parallel rays beyond the expected
    one.
    """
    subject.need_lines()
    grid, volume = _smooth(subject)
    right, down, look = _frame()
    shape, corner = (5, 5), -2.2 * right - 2.4 * down
    points = corner + _steps(shape) @ torch.stack([1.2 * down, 1.1 * right])
    limit, worst = subject.values(grid, points - 8 * look, points + 8 * look, volume), 0.0
    for distance in (1e2, 1e3, 1e5, 1e7):
        rig = _facing(subject, (corner, 1.1 * right, 1.2 * down), shape, distance, 1 + 8 / distance)
        integrals = subject.projector(grid, rig)(volume[None, None]).flatten()
        worst = greatest([worst, gap(integrals, limit) - 20 / distance])
    return worst


def magnified(subject: ProjectorSubject) -> float:
    """Detectors at 1.0001 to 50 times the object's distance with pixels in proportion: views equal
    those of individual rays.
    """
    subject.need_lines()
    if subject.beam[0]:
        raise DoesNotApply("parallel rays magnify nothing")
    grid, volume = _smooth(subject)
    right, down, look = _frame()
    shape, corner, worst = (5, 5), -2.2 * right - 2.4 * down, 0.0
    points = corner + _steps(shape) @ torch.stack([1.2 * down, 1.1 * right])
    for k in (1.0001, 1.01, 1.5, 5.0, 50.0):
        distance = max(12.0, 8 / (k - 1))
        rig = _facing(subject, (corner, 1.1 * right, 1.2 * down), shape, distance, k)
        source = (-distance * look).expand_as(points)
        integrals = subject.projector(grid, rig)(volume[None, None]).flatten()
        worst = greatest(
            [
                worst,
                gap(
                    integrals, subject.values(grid, source, source + 3 * (points - source), volume)
                ),
            ]
        )
    return worst


def flat(_: Subject) -> float:
    """Number of accepted detectors at 1e-10 mm from their source."""
    source, axes, accepted = torch.zeros(1, 3), torch.eye(3, dtype=torch.float64)[:, None], 0
    for pixels in (9, 64):
        try:
            origin = 1e-10 * axes[2] - (pixels - 1) / 2 * (axes[0] + axes[1])
            Cameras(source, origin, axes[0], axes[1], (pixels, pixels))
        except ValueError as error:
            if "flat" not in str(error):
                raise
        else:
            accepted += 1
    return float(accepted)


def anisotropic(subject: ProjectorSubject) -> float:
    """Flat and long voxels with ratios up to 1e4, filled with ones: chords of rays between opposite
    faces.
    """
    subject.need_exact()
    spacings = (
        (0.7, 0.7, 5.0),
        (5.0, 0.7, 0.7),
        (1e-2, 1.0, 1e2),
        (1e2, 1e-2, 1.0),
        (1.0, 1e4, 1.0),
    )
    return greatest(
        _chords(subject, Grid.centred(size=(7, 6, 5), spacing=mm, centre=(3.0, -2.0, 4.0)))
        for mm in spacings
    )


def coarse_and_fine(subject: ProjectorSubject) -> float:
    """Pixels of 9 voxels and of 1 / 40 voxel: mean of a blob's integrals, with the blob visible in
    every view.
    """
    subject.need_lines()
    grid = Grid.centred((48, 48, 48), 1.0, (3.0, -2.0, 4.0))
    blob, worst = Blob(grid.centre + torch.tensor([0.3, -0.2, 0.4]), 7.0), 0.0
    volume = blob.values(grid).to(subject.device, subject.dtype)[None, None]
    for mm in (1.2, 0.003):
        rig = subject.rig(grid, {"pixels": [6, 5], "pixel_mm": mm}, n_views=7)
        views, expected = (
            subject.projector(grid, rig)(volume)[0, 0].double().cpu(),
            blob.integrals(*rig.rays()),
        )
        lost = (views.amax(dim=(1, 2)) == 0).sum()
        worst = greatest([worst, float(lost), float((views.mean() / expected.mean() - 1).abs())])
    return worst


def thin(subject: ProjectorSubject) -> float:
    """One voxel, one slice, one row, prime sizes: chords of ones, and sums along rows of random
    values.
    """
    subject.need_exact()
    worst = 0.0
    for shape in SHAPES:
        grid = Grid.centred(size=shape[::-1], spacing=(0.9, 1.2, 1.0), centre=(3.0, -2.0, 4.0))
        volume = subject.random(*shape)
        start, end, sums = rows(grid, volume)
        worst = greatest(
            [worst, gap(subject.values(grid, start, end, volume), sums), _chords(subject, grid)]
        )
    return worst


def letter(subject: ProjectorSubject) -> float:
    """The letter F in a volume, viewed from all six sides in four orientations with one ray per
    pixel: number of pixels that differ from the upright letter.
    """
    subject.need("pixelwise")
    violations = 0.0
    for right, down in itertools.permutations(torch.cat([torch.eye(3), -torch.eye(3)]).double(), 2):
        if (right * down).any():
            continue
        look = torch.linalg.cross(right, down)
        way = torch.stack([look, down, right])
        axes, signs = way.abs().argmax(dim=1).tolist(), way.sum(dim=1).tolist()
        slices = torch.stack([torch.zeros_like(LETTER), LETTER]).flip(
            [i for i in range(3) if signs[i] < 0]
        )
        volume = slices.permute([axes.index(axis) for axis in (2, 1, 0)])
        grid = Grid.centred(
            size=volume.shape[::-1], spacing=(0.9, 1.2, 1.0), centre=(3.0, -2.0, 4.0)
        )
        u, v = grid.spacing[axes[2]] * right, grid.spacing[axes[1]] * down
        rig = _facing(subject, (grid.centre - u - 2 * v, u, v), (5, 3), 1e5, 1.5)
        A = subject.projector(grid, rig)
        image = A(volume.to(subject.device, subject.dtype)[None, None])[0, 0, 0].cpu()
        violations += float((~((image / image.max() - LETTER).abs() <= 1e-3)).sum())
    return violations


def _chords(subject: ProjectorSubject, grid: Grid) -> float:
    """The relative error of a box of ones."""
    start, end, lengths = through(grid)
    return float((subject.values(grid, start, end) / lengths - 1).abs().max())


def _smooth(subject: ProjectorSubject) -> tuple[Grid, Tensor]:
    """A blob at the origin that decays within its grid."""
    grid = Grid.centred(size=(14, 15, 16), spacing=(0.4, 0.45, 0.5))
    blob = Blob(torch.tensor([0.3, -0.2, 0.4], dtype=torch.float64), 1.5)
    return grid, blob.values(grid).to(subject.device, subject.dtype)


def _frame() -> Tensor:
    """Right, down and forward directions of a camera in a generic pose."""
    return random_rotation(torch.Generator().manual_seed(5))


def _steps(shape: Sequence[int]) -> Tensor:
    """(row, column) of every pixel, row by row."""
    return torch.cartesian_prod(*[torch.arange(n, dtype=torch.float64) for n in shape])


def _facing(
    subject: ProjectorSubject,
    plane: tuple[Tensor, Tensor, Tensor],
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
    look = torch.nn.functional.normalize(torch.linalg.cross(u, v), dim=0)
    if parallel:
        source, origin, k = corner - 8 * look, corner + 8 * look, 1.0
    else:
        source = corner + (shape[1] - 1) / 2 * u + (shape[0] - 1) / 2 * v - distance * look
        k = -k if extent == "behind" else k
        origin = source + k * (corner - source)
    return Cameras(source[None], origin[None], k * u[None], k * v[None], shape, parallel, extent)


CASES = (
    Case(12, "voxels of 1e-6 to 1e6 mm", "proportional views", "projector", scaled, DIGITS),
    Case(
        13,
        "rig and volume 1 to 1e6 mm from the origin",
        "the same views",
        "projector",
        far_away,
        FAR,
    ),
    Case(
        14,
        "a source 1e2 to 1e7 mm away",
        "parallel rays in the limit",
        "projector",
        far_source,
        DIGITS,
    ),
    Case(14, "magnification of 1.0001 to 50", "equal to single rays", "projector", magnified, FAR),
    Case(14, "a detector 1e-10 mm from its source", "an error", "mvrecon", flat),
    Case(
        15,
        "voxels 7 and 1e4 times as long as wide",
        "chords of a box of ones",
        "projector",
        anisotropic,
        PRECISE,
    ),
    Case(
        16,
        "pixels of 9 and of 1/40 voxels",
        "the mean of a blob in every view",
        "projector",
        coarse_and_fine,
        1e-2,
    ),
    Case(
        17,
        "volumes of one voxel, slice or row",
        "chords, and sums of rows",
        "projector",
        thin,
        DIGITS,
    ),
    Case(
        20, "the letter F from six sides, each way up", "upright in every view", "projector", letter
    ),
)
