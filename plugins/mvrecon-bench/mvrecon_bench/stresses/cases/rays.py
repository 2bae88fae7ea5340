"""Rays in special positions: along axes, on faces and edges, through corners, outside the
volume.
"""

import itertools
from dataclasses import replace

import torch
from torch import Tensor

from mvrecon.geometry.cameras.camera import VECTORS
from mvrecon.geometry.grid import Box, Grid, three
from mvrecon.testing.measures import greatest
from mvrecon_bench.stresses.analytic import DIRECTIONS, box_lengths, ends, rows, ways
from mvrecon_bench.stresses.case import Case
from mvrecon_bench.stresses.subject import ProjectorSubject

#: Tolerance: exact in float64 except for the rotation of rays into voxel space; float32 rounds each
#: of about ten sums.
EXACT = {torch.float64: 1e-13, torch.float32: 1e-6}
#: Deviation of a ray from its axis relative to its length; the last two are subnormal.
TILTS = (1e-3, 1e-5, 1e-8, 1e-12, 1e-20, 1e-30, 1e-160, 1e-310, 5e-324)


def axis_aligned(subject: ProjectorSubject) -> float:
    """Rays through rows of voxel centres along all three axes, in both directions: sums times the
    spacing.
    """
    subject.need_exact()
    worst = 0.0
    for n in (4, 5):
        grid = Grid.centred(
            size=(n + 2, n + 1, n), spacing=(0.9, 1.2, 1.0), centre=(3.0, -2.0, 4.0)
        )
        volume = subject.random(*grid.shape)
        start, end, sums = rows(grid, volume)
        for a, b in ((start, end), (end, start)):
            integrals = subject.values(grid, a, b, volume)
            worst = greatest([worst, float((integrals - sums).abs().max() / sums.max())])
    return worst


def on_faces(subject: ProjectorSubject) -> float:
    """Rays on every face and edge of voxels: deviation from the upper voxel, or from the range of
    the neighbours.
    """
    subject.need_exact()
    subject.need("bits")
    grid, volume = _integers(subject)
    worst = 0.0
    for axis in range(3):
        sums = volume.double().cpu().sum(dim=2 - axis).mT * grid.spacing[axis]
        halves = torch.cartesian_prod(*[torch.arange(-1, 2 * n).double() / 2 for n in sums.shape])
        lower, upper = ((halves - 0.5).ceil().long() + 1, (halves + 0.5).floor().long() + 1)
        padded = torch.nn.functional.pad(sums, (1, 1, 1, 1))
        around = torch.stack(
            [padded[b[:, 0], c[:, 1]] for b in (lower, upper) for c in (lower, upper)]
        )
        least, most = (around[-1], around[-1]) if subject.of_cells else around.aminmax(dim=0)
        start, end = ends(grid, axis, halves)
        for a, b in ((start, end), (end, start)):
            integrals = subject.values(grid, a, b, volume)
            worst = greatest(
                [worst, float(torch.maximum(integrals - most, least - integrals).max())]
            )
    return worst


def abutting(subject: ProjectorSubject) -> float:
    """Two adjacent volumes along each axis: for oblique rays and rays on faces and edges, their
    views sum to those of the whole.
    """
    subject.need_exact()
    grid, volume = _integers(subject)
    rays = [
        ends(grid, axis, torch.cartesian_prod(*[torch.arange(-1, 8).double() / 2] * 2))
        for axis in range(3)
    ]
    aim = subject.random(40, 3, seed=1).double().cpu() - 0.5
    rays.append((aim - 30, aim.flip(0) + 30))
    start, end = (torch.cat(points) for points in zip(*rays, strict=True))
    whole = subject.values(grid, start, end, volume)
    worst = 0.0
    for axis, at in itertools.product(range(3), (1, 2)):
        low, high = [0, 0, 0], [4, 4, 4]
        low[axis] = high[axis] = at
        parts = Box((0, 0, 0), three(high)), Box(three(low), (4, 4, 4))
        total = sum(
            subject.values(grid.cropped(box), start, end, volume[box.slices]) for box in parts
        )
        worst = greatest([worst, float((total - whole).abs().max() / whole.max())])
    return worst


def through_corners(subject: ProjectorSubject) -> float:
    """Lines in integer directions through the centre of 6^3 voxels, which is a corner of eight of
    them.
    """
    subject.need_exact()
    grid, way = Grid.centred((6, 6, 6), 1.0), ways()
    lengths = 6 * way.norm(dim=-1) / way.abs().amax(dim=-1)
    return float((subject.values(grid, -9 * way, 10 * way) / lengths - 1).abs().max())


def turned_corners(subject: ProjectorSubject) -> float:
    """Lines through lattice points: permuting or reversing the axes of rig and volume together
    does not change the views.
    """
    grid, way = Grid.centred((6, 6, 6), 1.0), ways()
    point = torch.randint(-2, 3, way.shape, generator=torch.Generator().manual_seed(0)).double()
    rig, volume = subject.rays(point - 9 * way, point + 9 * way), subject.random(6, 6, 6)

    def views(turn: Tensor, x: Tensor) -> Tensor:
        source, origin, u, v = (getattr(rig, name) @ turn for name in VECTORS)
        turned = replace(rig, source=source, origin=origin, u=u * turn.det().sign(), v=v)
        A = subject.projector(grid, turned)  # of one pixel, whose u may be reversed
        return A(x.to(subject.device)[None, None]).flatten().double().cpu()

    axes, worst = torch.eye(3, dtype=torch.float64), 0.0
    expected = views(axes, volume)
    for order in itertools.permutations(range(3)):
        turned = volume.permute(2, 1, 0).permute(order).permute(2, 1, 0)
        again = views(axes[:, order], turned)
        worst = greatest([worst, float((again - expected).abs().max() / expected.max())])
    free = (way != 0).all(dim=1)  # the others are in faces, which belong to the upper voxel
    for axis in range(3):
        sign = torch.ones(3, dtype=torch.float64)
        sign[axis] = -1
        gaps = (views(axes * sign, volume.flip(2 - axis)) - expected)[free].abs()
        worst = greatest([worst, float(gaps.max() / expected.max())])
    return worst


def grazing(subject: ProjectorSubject) -> float:
    """Number of faulty rays of a fan along an axis, for a volume that is displaced in tiny steps.

    A ray is faulty if it is not finite, nonzero although it misses the volume, or zero although it
    does not.
    """
    grid = Grid.centred(size=(7, 6, 5), spacing=(1.0, 1.2, 0.9))
    half = torch.tensor([3.15, 3.6, 2.5], dtype=torch.float64)
    steps = torch.tensor(
        [0.0, 0.9, 1 - 1e-9, 1.0, 1 + 1e-12, 1 + 1e-9, 1.0001, 1.5, 4.0, 1e3], dtype=torch.float64
    )
    shifts = torch.cat([steps[:, None] * half * torch.tensor(way) for way in DIRECTIONS[:3]])
    fan = torch.cartesian_prod(*[2.0 * torch.arange(-3, 4, dtype=torch.float64)] * 2)
    source, pixel = torch.zeros(2, len(fan), 3, dtype=torch.float64).unbind()
    source[:, 0], pixel[:, 0], pixel[:, 1:] = -40, 30, fan
    orders = [[0, 1, 2], [2, 0, 1], [1, 2, 0]]
    start, end = (
        torch.cat([(p[:, o][:, None] + shifts).flatten(0, 1) for o in orders])
        for p in (source, pixel)
    )
    rig, volume = subject.rays(start, end), 1 + subject.random(5, 6, 7)
    integrals = subject.values(grid, start, end, volume)
    reach = 1e-6 if subject.of_cells else 1.0
    misses, hits = (
        box_lengths(rig, grid, reach).flatten() == 0,
        box_lengths(rig, grid, -0.5).flatten() > 0.1,
    )
    return float(
        (~integrals.isfinite() | (misses & (integrals != 0)) | (hits & ~(integrals > 0))).sum()
    )


def nearly_aligned(subject: ProjectorSubject) -> float:
    """Rays tilted from a row of voxel centres in tiny steps, in both directions: change of the
    views beyond that expected from the tilt.
    """
    grid, worst = Grid.centred(size=(9, 7, 5), spacing=(0.9, 1.2, 1.0)), 0.0
    volume = subject.random(*grid.shape)
    for axis in range(3):
        tilts, way = _tilted(axis)
        integrals = subject.values(grid, -30 * way, 30 * way, volume)
        worst = greatest([worst, float(((integrals / integrals[0] - 1).abs() - 20 * tilts).max())])
    return worst


def nearly_on_faces(subject: ProjectorSubject) -> float:
    """Rays tilted from the face between two rows of voxels in tiny steps: deviation from the range
    of the two rows.
    """
    grid, worst = Grid.centred((4, 4, 4), (0.9, 1.2, 1.0)), 0.0
    volume = subject.random(*grid.shape)
    for axis in range(3):
        tilts, way = _tilted(axis)
        start, end = torch.zeros_like(way), 60 * way
        start[:, axis], end[:, axis] = -30, 30
        beside = torch.cartesian_prod(
            *[torch.tensor([0.0] if i == axis else [-0.5, 0.5]) for i in range(3)]
        )
        offset = beside.double() * torch.tensor(grid.spacing)
        known = subject.values(grid, start[:1] + offset, end[:1] + offset, volume)
        integrals = subject.values(grid, start, end, volume)
        excess = (
            torch.maximum(integrals - known.max(), known.min() - integrals) / known.max()
            - 20 * tilts
        )
        worst = greatest([worst, float(excess.max())])
    return worst


def _integers(subject: ProjectorSubject) -> tuple[Grid, Tensor]:
    """A grid and a volume whose sums are exact in every dtype, including half precision."""
    return Grid.centred((4, 4, 4), (0.5, 2.0, 1.0)), (8 * subject.random(4, 4, 4)).floor() + 1


def _tilted(axis: int) -> tuple[Tensor, Tensor]:
    """Tilts, beginning with 0, and directions along an axis, tilted towards one or both of the
    others.
    """
    one, two = (axis + 1) % 3, (axis + 2) % 3
    tilts, ways = [0.0], [torch.eye(3, dtype=torch.float64)[axis]]
    for tilt, b, c in itertools.product(TILTS, (-1, 0, 1), (-1, 0, 1)):
        way = torch.eye(3, dtype=torch.float64)[axis]
        way[one], way[two] = tilt * b, tilt * c
        tilts, ways = [*tilts, tilt], [*ways, way]
    return torch.tensor(tilts, dtype=torch.float64), torch.stack(ways)


CASES = (
    Case(
        1,
        "rays along the axes",
        "sum of voxels times spacing",
        "projector",
        axis_aligned,
        EXACT,
    ),
    Case(
        2,
        "rays on faces and edges of voxels",
        "the upper voxel, or a value between both",
        "projector",
        on_faces,
    ),
    Case(
        2,
        "two adjacent volumes",
        "views add up",
        "projector",
        abutting,
        EXACT,
    ),
    Case(3, "rays through corners", "chords of a box of ones", "projector", through_corners, EXACT),
    Case(
        3,
        "rays through corners, permuted axes",
        "equal views of the permuted volume",
        "projector",
        turned_corners,
        EXACT,
    ),
    Case(4, "rays that graze a volume", "finite, zero where they miss", "projector", grazing),
    Case(
        5,
        "rays nearly along an axis",
        "close to the ray along the axis",
        "projector",
        nearly_aligned,
        EXACT,
    ),
    Case(
        5,
        "rays nearly on faces",
        "between the values of adjacent rows",
        "projector",
        nearly_on_faces,
        EXACT,
    ),
)
