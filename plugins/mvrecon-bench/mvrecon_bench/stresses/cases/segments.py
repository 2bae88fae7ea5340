"""End points of rays: short rays, sources and pixels inside and outside the volume, tiled
detectors.
"""

import itertools
from dataclasses import replace
from functools import partial

import torch

from mvrecon.geometry.cameras.camera import Cameras, ExplicitRays
from mvrecon.geometry.grid import Grid
from mvrecon.testing.measures import gap, greatest
from mvrecon_bench.stresses.analytic import box_lengths
from mvrecon_bench.stresses.case import Case
from mvrecon_bench.stresses.cases.rays import EXACT
from mvrecon_bench.stresses.subject import ProjectorSubject, Subject


def short(subject: ProjectorSubject) -> float:
    """Rays down to 1e-18 mm at the centre of a voxel: value times length, and finite gradients."""
    subject.need_segment()
    subject.need_lines()
    grid, volume = Grid.centred(size=(9, 7, 5), spacing=(0.9, 1.2, 1.0)), subject.random(5, 7, 9)
    volume[1:4, 2:5, 3:6] = 1.75
    lengths = 10.0 ** -torch.arange(3.0, 19.0, 3.0, dtype=torch.float64)
    way = torch.nn.functional.normalize(torch.tensor([0.8, -0.5, 0.3], dtype=torch.float64), dim=0)
    end = lengths[:, None] * way
    integrals = subject.values(grid, torch.zeros_like(end), end, volume)
    return float((integrals / (1.75 * lengths) - 1).abs().max())


def pointless(_: Subject) -> float:
    """Number of interfaces that accept a ray of zero length."""
    point, u, v = torch.eye(3, dtype=torch.float64)[:, None]
    geometries = [lambda: ExplicitRays(point[None, None], point[None, None])]
    geometries += [
        partial(Cameras, point, point, u, v, (1, 1), parallel) for parallel in (False, True)
    ]
    accepted = 0
    for make in geometries:
        try:
            make()
        except ValueError as error:
            if not any(word in str(error) for word in ("length", "flat")):
                raise
        else:
            accepted += 1
    return float(accepted)


def inside(subject: ProjectorSubject, source: bool, pixel: bool) -> float:
    """Rays that start or end inside a box of ones: exactly their length in it."""
    subject.need_segment()
    subject.need_lines() if source and pixel else subject.need_exact()
    grid, rng = Grid.centred((16, 16, 16), 1.0, (3.0, -2.0, 4.0)), torch.Generator().manual_seed(0)
    place = torch.rand(2, 60, 3, generator=rng, dtype=torch.float64) * 6 - 3
    place[0, :, 0], place[1, :, 0] = (
        (place[0, :, 0] - 4 if source else -30),
        (place[1, :, 0] + 4 if pixel else 30),
    )
    start, end = (
        torch.stack([p.roll(k, dims=1) for k in range(3)]).flatten(0, 1) + grid.centre
        for p in place
    )
    lengths = box_lengths(subject.rays(start, end), grid).flatten()
    return float((subject.values(grid, start, end) / lengths - 1).abs().max())


def tiled(subject: ProjectorSubject) -> float:
    """A detector that intersects the volume, as a whole and in tiles of 1, 7 and 64 pixels."""
    subject.need("pixelwise")
    grid = Grid.centred((16, 16, 16), 1.0, (3.0, -2.0, 4.0))
    rig = _cut(
        subject.rig(
            grid, {"pixels": [5, 9], "pixel_mm": [2.2, 1.3], "offset_mm": [0.4, -0.3]}, n_views=2
        ),
        grid,
    )
    volume = subject.random(1, 1, 16, 16, 16)
    whole, worst = subject.projector(grid, rig)(volume), 0.0
    if subject.of_cells:
        lengths = box_lengths(rig, grid)
        ones = subject.projector(grid, rig)(torch.ones_like(volume))[0, 0].double().cpu()
        worst = gap(ones, lengths)
    for tile in (1, 7, 64):
        parts = torch.zeros_like(whole)
        for row, column in itertools.product(range(0, 5, tile), range(0, 9, tile)):
            shape = min(tile, 5 - row), min(tile, 9 - column)
            shift = row * rig.v + column * rig.u
            source = rig.source + shift if rig.parallel else rig.source
            cut = replace(rig, source=source, origin=rig.origin + shift, shape=shape)
            part = subject.projector(grid, cut)(volume)
            parts[..., row : row + shape[0], column : column + shape[1]] = part
        worst = greatest([worst, gap(parts, whole)])
    return worst


def out_of_reach(subject: ProjectorSubject) -> float:
    """Number of nonzero rays for a volume entirely behind the source or the detector."""
    grid, rng = (
        Grid.centred(size=(7, 6, 5), spacing=(1.0, 1.2, 0.9), centre=(3.0, -2.0, 4.0)),
        torch.Generator().manual_seed(0),
    )
    way = torch.nn.functional.normalize(
        torch.randn(60, 3, generator=rng, dtype=torch.float64), dim=-1
    )
    way = torch.cat([way, torch.eye(3, dtype=torch.float64), -torch.eye(3, dtype=torch.float64)])
    aim = grid.centre + 2 * torch.rand(len(way), 3, generator=rng, dtype=torch.float64) - 1
    integrals = [subject.values(grid, aim + near * way, aim + 40 * way) for near in (9.0, 30.0)]
    if subject.beam[1] == "segment":
        integrals += [
            subject.values(grid, aim + 40 * way, aim + near * way) for near in (9.0, 30.0)
        ]
    return float((torch.stack(integrals) != 0).sum())


def _cut(rig: Cameras, grid: Grid) -> Cameras:
    """The same rays, with finite ends on a plane through the grid's centre."""
    if rig.extent != "segment":
        return rig
    part = (rig.project(grid.centre)[:, 2] / rig.distance)[:, None]
    wide = torch.ones_like(part) if rig.parallel else part
    origin = rig.source + part * (rig.origin - rig.source)
    return replace(rig, origin=origin, u=rig.u * wide, v=rig.v * wide)


CASES = (
    Case(
        6,
        "rays of 1e-3 to 1e-18 mm",
        "voxel value times length",
        "projector",
        short,
        EXACT,
    ),
    Case(6, "rays of zero length", "an error", "mvrecon", pointless),
    Case(
        7,
        "source inside the volume",
        "length from the source",
        "projector",
        partial(inside, source=True, pixel=False),
        EXACT,
    ),
    Case(
        7,
        "pixel inside the volume",
        "length up to the pixel",
        "projector",
        partial(inside, source=False, pixel=True),
        EXACT,
    ),
    Case(
        7,
        "source and pixel inside the volume",
        "length between them",
        "projector",
        partial(inside, source=True, pixel=True),
        EXACT,
    ),
    Case(
        8,
        "a detector inside the volume, in tiles",
        "views of the whole detector",
        "projector",
        tiled,
        EXACT,
    ),
    Case(9, "a volume behind the source or the detector", "zero views", "projector", out_of_reach),
)
