"""Which pixels see a brick, and sums over them."""

from dataclasses import replace

import pytest
import torch

from mvrecon.data.scenes.solids import Phantom
from mvrecon.geometry.cameras.rigs import circular, dome, parallel
from mvrecon.geometry.grid import Grid, bricks_along
from mvrecon.operators.visual_hull.footprints import (
    BrickFootprints,
    Bricks,
    footprint_sums,
    footprints,
    ray_gap,
    summed_area_tables,
)
from tests.operators.visual_hull.cases import KINDS, World, operator, random_world

DETECTOR = {"pixels": [9, 12], "pixel_mm": 1.0}


def bricks_of(grid: Grid, edge: int) -> Bricks:
    return Bricks.at(torch.ones(bricks_along(grid.shape, edge)).nonzero(), edge, grid.shape)


def covered(prints: BrickFootprints, shape: tuple[int, int]) -> torch.Tensor:
    """Pixels [m n v u] within the footprints."""
    v, u = (torch.arange(n) for n in shape)
    (u0, v0), (u1, v1) = prints.low[..., None], prints.high[..., None]
    return ((v >= v0) & (v < v1))[..., :, None] & ((u >= u0) & (u < u1))[..., None, :]


def test_bricks_tile_the_grid_and_the_last_are_truncated():
    shape, filled = (5, 9, 7), torch.zeros(5, 9, 7)
    bricks = bricks_of(Grid.centred(shape=shape, spacing=1.0), 4)
    assert len(bricks) == 2 * 3 * 2
    for low, high in zip(bricks.low.tolist(), bricks.high.tolist(), strict=True):
        filled[tuple(slice(*ends) for ends in zip(low, high, strict=True))] += 1
    assert (filled == 1).all()


@pytest.mark.pairwise(kind=KINDS, method=["joseph", "siddon", "trilinear"])
def test_no_pixel_that_a_brick_contributes_to_is_missed(kind: str, method: str):
    """Joseph and trilinear carry a value half a voxel beyond the brick, Siddon nowhere."""
    world = random_world(kind, 11)
    world = replace(
        world, grid=Grid(world.grid.shape, world.grid.affine), cameras=world.cameras[:2]
    )
    bricks = bricks_of(world.grid, 9)
    volumes = torch.zeros(len(bricks), 1, *world.grid.shape, dtype=torch.float64)
    for n, (low, high) in enumerate(zip(bricks.low.tolist(), bricks.high.tolist(), strict=True)):
        volumes[n, 0][tuple(slice(*ends) for ends in zip(low, high, strict=True))] = 1.0
    hit = operator(world, method)(volumes)[:, 0].transpose(0, 1) != 0
    prints = footprints(world.cameras, world.grid, bricks, reach=0.0 if method == "siddon" else 0.5)
    visible = covered(prints, world.cameras.shape)
    assert hit.any()
    assert not (hit & ~visible).any()


def test_a_whole_footprint_is_no_wider_than_the_shadow():
    """Of a brick that a dense detector sees, the first and last row and column are hit, but for the
    reach.
    """
    grid = Grid.centred((8, 8, 8), 1.0)
    rig = dome(3, 60.0, 40.0, 150.0, {"pixels": [120, 120], "pixel_mm": 0.1})
    bricks = bricks_of(grid, 4)
    prints = footprints(rig, grid, bricks, reach=0.0)
    volumes = torch.zeros(8, 1, 8, 8, 8, dtype=torch.float64)
    for n, (low, high) in enumerate(zip(bricks.low.tolist(), bricks.high.tolist(), strict=True)):
        volumes[n, 0][tuple(slice(*ends) for ends in zip(low, high, strict=True))] = 1.0
    hit = operator(World(grid, rig, Phantom(())), "siddon")(volumes)[:, 0].transpose(0, 1) > 0
    assert prints.whole.all()
    for axis, pixels in ((0, hit.any(dim=-2)), (1, hit.any(dim=-1))):
        first = pixels.int().argmax(dim=-1)
        last = pixels.shape[-1] - pixels.flip(-1).int().argmax(dim=-1)
        assert (first - prints.low[axis]).abs().max() <= 1
        assert (last - prints.high[axis]).abs().max() <= 1


def test_the_footprint_of_a_cube_in_front_of_a_source_is_known():
    """A cube of 2 mm at the axis of a cone beam: its near face, at 99 mm, is magnified 200 / 99
    times.
    """
    grid = Grid.centred((2, 2, 2), 1.0)
    rig = circular(1, 100.0, 200.0, {"pixels": [21, 31], "pixel_mm": 0.5})
    prints = footprints(rig, grid, bricks_of(grid, 2), reach=0.0)
    half = 200 / 99 / 0.5  # 4.04 pixels
    assert prints.low[:, 0, 0].tolist() == [15 - int(half), 10 - int(half)]
    assert prints.high[:, 0, 0].tolist() == [15 + int(half) + 1, 10 + int(half) + 1]
    wider = footprints(rig, grid, bricks_of(grid, 2), reach=0.0, gaps=True)
    assert wider.low[:, 0, 0].tolist() == [15 - 5, 10 - 5]  # 4.04 + (1 + sqrt 2) / 2 = 5.25


def test_a_brick_is_complete_only_if_all_of_it_is_within_the_extent():
    grid = Grid.centred((3, 3, 3), 2.0)
    brick = Bricks(torch.zeros(1, 3, dtype=torch.long), torch.full((1, 3), 3))
    wide = {"pixels": [99, 99], "pixel_mm": 1.0}
    cone, beam = circular(1, 40.0, 60.0, wide), parallel(1, wide, 20.0)
    pinhole = replace(cone, u=-cone.u, extent="behind")  # the object on the detector's side of it

    def whole(rig) -> bool:
        return bool(footprints(rig, grid, brick).whole.item())

    def empty(rig) -> bool:
        prints = footprints(rig, grid, brick)
        return bool((prints.low == prints.high).any())

    def along(rig, mm: float):
        return rig.moved(torch.eye(3), torch.tensor([mm, 0.0, 0.0]))

    assert whole(cone) and whole(beam) and not empty(cone)
    assert not whole(along(cone, -40)) and not empty(along(cone, -40))  # the source is in the brick
    assert not whole(along(cone, 20)) and not empty(along(cone, 20))  # the detector cuts it
    assert not whole(along(cone, -60)) and empty(along(cone, -60))  # behind the source
    assert not whole(along(cone, 50)) and empty(along(cone, 50))  # behind the detector
    assert not whole(along(beam, 10)) and not whole(along(beam, -10)) and empty(along(beam, 30))
    assert whole(replace(along(beam, 30), extent="line"))
    assert not whole(pinhole) and empty(pinhole)
    assert not whole(
        circular(1, 40.0, 60.0, {"pixels": [7, 99], "pixel_mm": 1.0})
    )  # beyond the rows


def test_sums_over_footprints_equal_those_over_pixels():
    rng = torch.Generator().manual_seed(0)
    for kind in KINDS:
        world = random_world(kind, 13)
        prints = footprints(world.cameras, world.grid, bricks_of(world.grid, 5))
        counts = torch.randint(
            0, 1000, (2, len(world.cameras), *world.cameras.shape), generator=rng
        )
        direct = torch.einsum(
            "bmvu,mnvu->bmn", counts.double(), covered(prints, world.cameras.shape).double()
        )
        assert torch.equal(footprint_sums(summed_area_tables(counts), prints).double(), direct)
        lit = counts > 500
        direct = torch.einsum(
            "bmvu,mnvu->bmn", lit.double(), covered(prints, world.cameras.shape).double()
        )
        assert torch.equal(footprint_sums(summed_area_tables(lit), prints).double(), direct)


def test_sums_of_counts_lose_no_count():
    table = summed_area_tables(torch.full((1, 40, 50), 2.0**31 - 128))
    assert table[0, -1, -1].item() == 2000 * (2**31 - 128)


def test_the_ray_gap_is_the_magnified_pixel_diagonal():
    grid, detector = Grid.centred((4, 4, 4), 10.0), {"pixels": [9, 12], "pixel_mm": [3.0, 4.0]}
    assert ray_gap(parallel(3, detector, 100.0), grid) == pytest.approx(5.0)
    cone = circular(1, 100.0, 200.0, detector)
    assert ray_gap(cone, grid) == pytest.approx(5.0 * 120 / 200)  # the far face
    assert ray_gap(circular(1, 100.0, 110.0, detector), grid) == pytest.approx(
        5.0
    )  # rays end in the grid
