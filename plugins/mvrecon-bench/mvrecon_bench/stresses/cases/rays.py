"""Rays in special positions: along axes, on faces and edges, through corners, outside the volume;
short rays, and those that start or end inside the volume.
"""

import itertools
from collections.abc import Iterator
from dataclasses import replace
from functools import partial

import torch
from torch import Tensor
from torch.nn.functional import normalize

from mvrecon.geometry.cameras.camera import VECTORS, Cameras, ExplicitRays
from mvrecon.geometry.grid import Box, Grid, three
from mvrecon.testing.measures import gap, greatest
from mvrecon_bench.stresses.analytic import DIRECTIONS, box_lengths, ends, rows, ways
from mvrecon_bench.stresses.case import EXACT, case, refused
from mvrecon_bench.stresses.subject import ProjectorSubject, Subject

AXES = torch.eye(3, dtype=torch.float64)
#: Deviation of a ray from its axis relative to its length; the last two are subnormal.
TILTS = (1e-3, 1e-5, 1e-8, 1e-12, 1e-20, 1e-30, 1e-160, 1e-310, 5e-324)
UNEVEN = {"spacing": (0.9, 1.2, 1.0), "centre": (3.0, -2.0, 4.0)}
CUBE = Grid.centred((16, 16, 16), 1.0, (3.0, -2.0, 4.0))


@case("projector", 1, EXACT)
def axis_aligned(subject: ProjectorSubject) -> Iterator[float]:
    """Rays along the axes: sum of voxels times spacing."""
    subject.need_exact()
    for n in (4, 5):
        grid = Grid.centred(size=(n + 2, n + 1, n), **UNEVEN)
        volume = subject.random(*grid.shape)
        start, end, sums = rows(grid, volume)
        for a, b in ((start, end), (end, start)):
            off = subject.values(grid, a, b, volume) - sums
            yield float(off.abs().max() / sums.max())


@case("projector", 2)
def on_faces(subject: ProjectorSubject) -> float:
    """Rays on faces and edges of voxels: the upper voxel, or a value between both."""
    subject.need_exact()
    subject.need("bits")
    grid, volume = _integers(subject)
    errors = []
    for axis in range(3):
        sums = volume.double().cpu().sum(dim=2 - axis).mT * grid.spacing[axis]
        halves = torch.cartesian_prod(*[torch.arange(-1, 2 * n).double() / 2 for n in sums.shape])
        lower, upper = (halves - 0.5).ceil().long() + 1, (halves + 0.5).floor().long() + 1
        padded = torch.nn.functional.pad(sums, (1, 1, 1, 1))
        corners = itertools.product((lower, upper), repeat=2)
        around = torch.stack([padded[b[:, 0], c[:, 1]] for b, c in corners])
        least, most = (around[-1], around[-1]) if subject.of_cells else around.aminmax(dim=0)
        start, end = ends(grid, axis, halves)
        for a, b in ((start, end), (end, start)):
            found = subject.values(grid, a, b, volume)
            errors.append(float(torch.maximum(found - most, least - found).max()))
    return greatest(errors)


@case("projector", 2, EXACT)
def abutting(subject: ProjectorSubject) -> Iterator[float]:
    """Two adjacent volumes: views add up, for oblique rays and rays on faces and edges."""
    subject.need_exact()
    grid, volume = _integers(subject)
    halves = torch.cartesian_prod(*[torch.arange(-1, 8).double() / 2] * 2)
    aim = subject.random(40, 3, seed=1).double().cpu() - 0.5
    rays = [*(ends(grid, axis, halves) for axis in range(3)), (aim - 30, aim.flip(0) + 30)]
    start, end = (torch.cat(points) for points in zip(*rays, strict=True))
    whole = subject.values(grid, start, end, volume)
    for axis, at in itertools.product(range(3), (1, 2)):
        low, high = [0, 0, 0], [4, 4, 4]
        low[axis] = high[axis] = at
        boxes = Box((0, 0, 0), three(high)), Box(three(low), (4, 4, 4))
        views = [subject.values(grid.cropped(b), start, end, volume[b.slices]) for b in boxes]
        yield float((sum(views) - whole).abs().max() / whole.max())


@case("projector", 3, EXACT)
def through_corners(subject: ProjectorSubject) -> float:
    """Rays through corners: chords of a box of ones."""
    subject.need_exact()
    grid, way = Grid.centred((6, 6, 6), 1.0), ways()  # its centre is a corner of eight voxels
    lengths = 6 * way.norm(dim=-1) / way.abs().amax(dim=-1)
    return float((subject.values(grid, -9 * way, 10 * way) / lengths - 1).abs().max())


@case("projector", 3, EXACT)
def turned_corners(subject: ProjectorSubject) -> Iterator[float]:
    """Rays through corners, permuted axes: equal views of the permuted volume."""
    grid, way = Grid.centred((6, 6, 6), 1.0), ways()
    point = torch.randint(-2, 3, way.shape, generator=torch.Generator().manual_seed(0)).double()
    rig, volume = subject.rays(point - 9 * way, point + 9 * way), subject.random(6, 6, 6)

    def views(turn: Tensor, x: Tensor) -> Tensor:
        source, origin, u, v = (getattr(rig, name) @ turn for name in VECTORS)
        turned = replace(rig, source=source, origin=origin, u=u * turn.det().sign(), v=v)
        A = subject.projector(grid, turned)  # of one pixel, whose u may be reversed
        return A(x.to(subject.device)[None, None]).flatten().double().cpu()

    expected = views(AXES, volume)
    most = float(expected.max())
    for order in itertools.permutations(range(3)):
        turned = volume.permute(2, 1, 0).permute(order).permute(2, 1, 0)
        yield float((views(AXES[:, order], turned) - expected).abs().max()) / most
    free = (way != 0).all(dim=1)  # the others are in faces, which belong to the upper voxel
    for axis in range(3):
        mirrored = views(AXES * (1 - 2 * AXES[axis]), volume.flip(2 - axis))
        yield float((mirrored - expected)[free].abs().max()) / most


@case("projector", 4)
def grazing(subject: ProjectorSubject) -> float:
    """Rays that graze a volume: finite, zero where they miss."""
    grid = Grid.centred(size=(7, 6, 5), spacing=(1.0, 1.2, 0.9))
    half = torch.tensor([3.15, 3.6, 2.5], dtype=torch.float64)
    steps = [0.0, 0.9, 1 - 1e-9, 1.0, 1 + 1e-12, 1 + 1e-9, 1.0001, 1.5, 4.0, 1e3]
    away = torch.tensor(steps, dtype=torch.float64)[:, None] * half
    shifts = torch.cat([away * torch.tensor(way) for way in DIRECTIONS[:3]])
    fan = torch.cartesian_prod(*[2.0 * torch.arange(-3, 4, dtype=torch.float64)] * 2)
    source, pixel = torch.zeros(2, len(fan), 3, dtype=torch.float64).unbind()
    source[:, 0], pixel[:, 0], pixel[:, 1:] = -40, 30, fan
    orders = [[0, 1, 2], [2, 0, 1], [1, 2, 0]]
    start, end = (
        torch.cat([(p[:, o][:, None] + shifts).flatten(0, 1) for o in orders])
        for p in (source, pixel)
    )
    found = subject.values(grid, start, end, 1 + subject.random(5, 6, 7))
    rig, reach = subject.rays(start, end), 1e-6 if subject.of_cells else 1.0
    misses = box_lengths(rig, grid, reach).flatten() == 0
    hits = box_lengths(rig, grid, -0.5).flatten() > 0.1
    return float((~found.isfinite() | (misses & (found != 0)) | (hits & ~(found > 0))).sum())


@case("projector", 5, EXACT)
def nearly_aligned(subject: ProjectorSubject) -> Iterator[float]:
    """Rays nearly along an axis: close to the ray along the axis."""
    grid = Grid.centred(size=(9, 7, 5), spacing=UNEVEN["spacing"])
    volume = subject.random(*grid.shape)
    for axis in range(3):
        tilts, way = _tilted(axis)
        found = subject.values(grid, -30 * way, 30 * way, volume)
        yield float(((found / found[0] - 1).abs() - 20 * tilts).max())


@case("projector", 5, EXACT)
def nearly_on_faces(subject: ProjectorSubject) -> Iterator[float]:
    """Rays nearly on faces: between the values of adjacent rows."""
    grid = Grid.centred((4, 4, 4), UNEVEN["spacing"])
    volume = subject.random(*grid.shape)
    for axis in range(3):
        tilts, way = _tilted(axis)
        start, end = torch.zeros_like(way), 60 * way
        start[:, axis], end[:, axis] = -30, 30
        halves = [torch.tensor([0.0] if i == axis else [-0.5, 0.5]) for i in range(3)]
        offset = torch.cartesian_prod(*halves).double() * torch.tensor(grid.spacing)
        known = subject.values(grid, start[:1] + offset, end[:1] + offset, volume)
        found = subject.values(grid, start, end, volume)
        beyond = torch.maximum(found - known.max(), known.min() - found)
        yield float((beyond / known.max() - 20 * tilts).max())


@case("projector", 6, EXACT)
def short(subject: ProjectorSubject) -> float:
    """Rays of 1e-3 to 1e-18 mm: voxel value times length."""
    subject.need_segment()
    subject.need_lines()
    grid, volume = Grid.centred(size=(9, 7, 5), spacing=UNEVEN["spacing"]), subject.random(5, 7, 9)
    volume[1:4, 2:5, 3:6] = 1.75
    lengths = 10.0 ** -torch.arange(3.0, 19.0, 3.0, dtype=torch.float64)
    end = lengths[:, None] * normalize(torch.tensor([0.8, -0.5, 0.3], dtype=torch.float64), dim=0)
    found = subject.values(grid, torch.zeros_like(end), end, volume)
    return float((found / (1.75 * lengths) - 1).abs().max())


@case("mvrecon", 6)
def pointless(_: Subject) -> float:
    """Rays of zero length, and a detector 1e-10 mm from its source: an error."""
    point, u, v = AXES[:, None]
    away = 1e-10 * v - 4 * (point + u)
    acts = {
        "a ray": lambda: ExplicitRays(point[None, None], point[None, None]),
        "a cone": partial(Cameras, point, point, u, v, (1, 1)),
        "a parallel beam": partial(Cameras, point, point, u, v, (1, 1), True),
        "a flat cone": partial(Cameras, 0 * point, away, point, u, (9, 9)),
        "a larger one": partial(Cameras, 0 * point, away - 27.5 * (point + u), point, u, (64, 64)),
    }
    return refused(acts, "length|flat")


@case("projector", 7, EXACT)
def inside(subject: ProjectorSubject) -> Iterator[float]:
    """Source, pixel or both inside the volume: length between them."""
    subject.need_segment()
    subject.need_lines()
    for source, pixel in ((True, True), (True, False), (False, True)):
        if not (source and pixel or subject.error_of_ones < 1e-4):
            continue  # samples along a ray that enters the volume
        rng = torch.Generator().manual_seed(0)
        place = torch.rand(2, 60, 3, generator=rng, dtype=torch.float64) * 6 - 3
        place[0, :, 0] = place[0, :, 0] - 4 if source else -30
        place[1, :, 0] = place[1, :, 0] + 4 if pixel else 30
        turned = ([p.roll(k, dims=1) for k in range(3)] for p in place)
        start, end = (torch.cat(points) + CUBE.centre for points in turned)
        lengths = box_lengths(subject.rays(start, end), CUBE).flatten()
        yield float((subject.values(CUBE, start, end) / lengths - 1).abs().max())


@case("projector", 8, EXACT)
def tiled(subject: ProjectorSubject) -> Iterator[float]:
    """A detector inside the volume, in tiles: views of the whole one, of 1, 7 and 64 pixels."""
    subject.need("pixelwise")
    detector = {"pixels": [5, 9], "pixel_mm": [2.2, 1.3], "offset_mm": [0.4, -0.3]}
    rig = _cut(subject.rig(CUBE, detector, n_views=2), CUBE)
    volume = subject.random(1, 1, *CUBE.shape)
    whole = subject.projector(CUBE, rig)(volume)
    if subject.of_cells:
        ones = subject.projector(CUBE, rig)(torch.ones_like(volume))[0, 0].double().cpu()
        yield gap(ones, box_lengths(rig, CUBE))
    for tile in (1, 7, 64):
        parts = torch.zeros_like(whole)
        for row, column in itertools.product(range(0, 5, tile), range(0, 9, tile)):
            ends = min(row + tile, 5), min(column + tile, 9)
            part = rig.cropped((row, ends[0]), (column, ends[1]))
            views = subject.projector(CUBE, part)(volume)
            parts[..., row : ends[0], column : ends[1]] = views
        yield gap(parts, whole)


@case("projector", 9)
def out_of_reach(subject: ProjectorSubject) -> float:
    """A volume behind the source or the detector: zero views."""
    grid = Grid.centred(size=(7, 6, 5), spacing=(1.0, 1.2, 0.9), centre=UNEVEN["centre"])
    rng = torch.Generator().manual_seed(0)
    way = normalize(torch.randn(60, 3, generator=rng, dtype=torch.float64), dim=-1)
    way = torch.cat([way, AXES, -AXES])
    aim = grid.centre + 2 * torch.rand(len(way), 3, generator=rng, dtype=torch.float64) - 1
    far, found = aim + 40 * way, []
    for near in (aim + 9 * way, aim + 30 * way):
        found.append(subject.values(grid, near, far))
        if subject.beam[1] == "segment":
            found.append(subject.values(grid, far, near))
    return float((torch.stack(found) != 0).sum())


def _cut(rig: Cameras, grid: Grid) -> Cameras:
    """The same rays, with finite ends on a plane through the grid's centre."""
    if rig.extent != "segment":
        return rig
    part = (rig.project(grid.centre)[:, 2] / rig.distance)[:, None]
    wide = torch.ones_like(part) if rig.parallel else part
    origin = rig.source + part * (rig.origin - rig.source)
    return replace(rig, origin=origin, u=rig.u * wide, v=rig.v * wide)


def _integers(subject: ProjectorSubject) -> tuple[Grid, Tensor]:
    """A grid and a volume whose sums are exact in every dtype, including half precision."""
    return Grid.centred((4, 4, 4), (0.5, 2.0, 1.0)), (8 * subject.random(4, 4, 4)).floor() + 1


def _tilted(axis: int) -> tuple[Tensor, Tensor]:
    """Tilts, beginning with 0, and directions along an axis, tilted towards one or both of the
    others.
    """
    one, two = AXES[(axis + 1) % 3], AXES[(axis + 2) % 3]
    tilted = list(itertools.product(TILTS, (-1, 0, 1), (-1, 0, 1)))
    ways = [AXES[axis] + tilt * b * one + tilt * c * two for tilt, b, c in tilted]
    tilts = torch.tensor([0.0, *(tilt for tilt, _, _ in tilted)], dtype=torch.float64)
    return tilts, torch.stack([AXES[axis], *ways])
