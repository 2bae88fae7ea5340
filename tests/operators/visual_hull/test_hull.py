"""Bricks that the visual hull keeps and removes."""

from dataclasses import replace

import pytest
import torch
from torch.nn.functional import max_pool3d

from mvrecon.data.scenes.phantoms import derenzo
from mvrecon.data.scenes.solids import Phantom, Solids, voxelise
from mvrecon.geometry.cameras.rigs import parallel
from mvrecon.geometry.grid import Grid, bricks_along, voxel_centres
from mvrecon.geometry.rigid import random_rotation
from mvrecon.operators.visual_hull import hull
from mvrecon.operators.visual_hull.footprints import Bricks, footprints
from mvrecon.operators.visual_hull.hull import expand, visual_hull
from tests.operators.visual_hull.cases import KINDS, World, operator, random_world

BRICKS = (1, 3, 4)
EDGE = 3


def occupied(volume: torch.Tensor, brick: int) -> torch.Tensor:
    return max_pool3d((volume > 0).float()[None, None], brick, ceil_mode=True)[:, 0] > 0


def kept(
    world: World, views: torch.Tensor | None = None, brick: int = EDGE, **options
) -> torch.Tensor:
    return visual_hull(
        world.views if views is None else views, world.cameras, world.grid, brick, **options
    )


@pytest.mark.parametrize("kind", KINDS)
def test_no_occupied_brick_is_removed_and_some_empty_ones_are(kind: str):
    """105 random worlds, 15 of each kind, seen by exact integrals and by the operator of a voxel
    phantom.
    """
    fractions = []
    for seed in range(15):
        world, brick = random_world(kind, seed), BRICKS[seed % len(BRICKS)]
        volume = voxelise(world.phantom, world.grid, 3)
        assert (volume > 0).any()
        projection = operator(world)(volume[None, None])
        for views in (world.views, projection):
            stays = kept(world, views, brick)
            assert not (occupied(volume, brick) & ~stays).any(), f"{kind}, seed {seed}"
            fractions.append(stays.float().mean().item())
    assert min(fractions) < (1.0 if kind == "inside" else 0.7)


def test_a_lone_voxel_is_kept_where_the_rays_are_no_further_apart_than_voxels():
    rng = torch.Generator().manual_seed(0)
    grid = Grid.centred((12, 12, 12), 1.0)
    rig = parallel(5, {"pixels": [20, 20], "pixel_mm": 1.0, "offset_mm": 0.4}, 40.0).moved(
        random_rotation(rng), torch.tensor([0.13, 0.21, -0.17])
    )
    world = World(grid, rig, Phantom(()))
    volume = torch.zeros(50, 1, *grid.shape)
    volume.flatten(1)[torch.arange(50), torch.randperm(12**3, generator=rng)[:50]] = 1.0
    stays = kept(world, operator(world)(volume), 2)
    assert not (max_pool3d(volume, 2)[:, 0].bool() & ~stays).any()
    assert stays.float().mean() < 0.25


def test_results_do_not_depend_on_coarse_bricks_and_chunks(monkeypatch):
    for kind in KINDS:
        world = random_world(kind, 3)
        once = kept(world, brick=2)
        monkeypatch.setattr(hull, "PASS_VIEWS", 1)
        monkeypatch.setattr("mvrecon.operators.visual_hull.footprints.AT_ONCE", 499)
        assert torch.equal(kept(world, brick=2), once)
        monkeypatch.setattr(hull, "COARSE_FACTOR", 1000)
        monkeypatch.setattr("mvrecon.operators.visual_hull.footprints.AT_ONCE", 2**15)
        assert torch.equal(kept(world, brick=2), once)
        monkeypatch.undo()


@pytest.mark.parametrize("kind", KINDS)
def test_the_hull_shrinks_with_every_view_in_any_order(kind: str):
    world = random_world(kind, 5)
    views, last = world.views, torch.ones(1, 1, 1, 1, dtype=torch.bool)
    for count in range(1, len(world.cameras) + 1):
        some = replace(world, cameras=world.cameras[:count])
        now = kept(some, views[:, :, :count])
        assert not (now & ~last).any()
        last = now
    order = torch.randperm(len(world.cameras), generator=torch.Generator().manual_seed(1)).tolist()
    assert torch.equal(kept(replace(world, cameras=world.cameras[order]), views[:, :, order]), last)


@pytest.mark.parametrize("kind", KINDS)
def test_the_hull_moves_with_the_world(kind: str):
    world, rng = random_world(kind, 7), torch.Generator().manual_seed(2)
    R, t = random_rotation(rng), 300 * torch.randn(3, generator=rng, dtype=torch.float64)
    moved_world = World(
        world.grid.moved(R, t), world.cameras.moved(R, t), world.phantom.moved(R, t)
    )
    assert torch.equal(kept(moved_world, world.views), kept(world))


def test_only_bricks_that_no_view_sees_entirely_remain_for_zero_views():
    for kind in KINDS:
        world = random_world(kind, 4)
        lattice = bricks_along(world.grid.shape, EDGE)
        bricks = Bricks.at(torch.ones(lattice).nonzero(), EDGE, world.grid.shape)
        whole = (
            footprints(world.cameras, world.grid, bricks, gaps=True)
            .whole.any(dim=0)
            .reshape(lattice)
        )
        stays = kept(world, torch.zeros_like(world.views))[0]
        assert torch.equal(stays, ~whole)
        assert whole.any()


@pytest.mark.parametrize("kind", ["inside", "beams", "dcspect80"])
def test_what_is_given_up_unseen_is_what_the_data_know_nothing_of(kind: str):
    """The adjoint of the views is zero there, so that MLEM makes it zero in its first step; the
    rest explains all.
    """
    given_up = 0
    for seed in range(6):
        world = random_world(kind, seed)
        volume = voxelise(world.phantom, world.grid, 3)[None, None]
        A = operator(world)
        views = A(volume)
        stays = kept(world, views, 2, keep_unseen=False)
        gone = kept(world, views, 2) & ~stays
        given_up += int(gone.sum())
        assert not (A.T(views)[0] * expand(gone, 2, world.grid.shape)[0]).any()
        assert torch.allclose(
            A(volume * expand(stays, 2, world.grid.shape)), views, rtol=1e-6, atol=1e-6
        )
    assert given_up


def test_the_hull_of_a_derenzo_phantom_with_parallel_beams_follows_the_geometry():
    """The views' shadows of the phantom's cylinder bound the hull: no brick beyond them, by its
    size and the gaps.
    """
    grid, brick, views, pixel = Grid.centred((48, 48, 48), 1.0), 2, 24, 0.8
    rig = parallel(views, {"pixels": [70, 90], "pixel_mm": pixel}, 90.0)
    phantom = derenzo((3, 2.5, 2.5, 2, 2, 2), 9.0, 14.0)
    stays = kept(World(grid, rig, phantom), brick=brick)
    inner = (slice(brick // 2, None, brick),) * 3
    x, y, z = (centres[inner] - 0.5 for centres in voxel_centres(grid).unbind(dim=-1))
    more = 0.5 * 2**0.5 + pixel * (1 + 2**0.5) / 2 + 0.01  # the reach and the gaps
    radius = (9.0 + more + brick / 2 * 2**0.5) / torch.cos(torch.tensor(torch.pi / (2 * views)))
    bound = (torch.hypot(x, y) <= radius) & (z.abs() <= 7.0 + more + brick / 2)
    assert not (stays & ~bound).any()
    assert stays.float().mean() < 0.08  # of the cube; the cylinder is 0.032 of it
    assert not (occupied(voxelise(phantom, grid, 4), brick) & ~stays).any()


def test_items_of_a_batch_are_independent():
    world = random_world("cone", 2)
    other = world.views.flip(-1)
    both = torch.cat([world.views, other, torch.zeros_like(other)])
    hulls = [kept(world, views[None]) for views in both]
    assert torch.equal(kept(world, both), torch.cat(hulls))
    assert not torch.equal(hulls[0], hulls[1])


def test_pixels_up_to_the_threshold_are_empty():
    world = random_world("cone", 1)
    lifted = world.views + 0.25
    assert kept(world, lifted).all()
    assert torch.equal(kept(world, lifted, threshold=0.25), kept(world))
    assert torch.equal(kept(world, lifted, threshold=torch.full_like(lifted, 0.25)), kept(world))
    assert kept(world, threshold=world.views.max().item()).sum() < kept(world).sum()


def test_the_required_number_of_views_must_agree():
    """With k witnesses stays what any choice of all but k - 1 of the views keeps."""
    world = random_world("pinholes", 6)
    count = len(world.cameras)
    left_out = [[m for m in range(count) if m != out] for out in range(count)]
    any_keeps = torch.stack(
        [
            kept(replace(world, cameras=world.cameras[some]), world.views[:, :, some])
            for some in left_out
        ]
    ).any(dim=0)
    assert torch.equal(kept(world, witnesses=2), any_keeps)
    assert kept(world, witnesses=count + 1).all()


def test_bricks_are_expanded_to_voxels_and_truncated_at_the_grid():
    bricks = torch.zeros(2, 2, 3, 2, dtype=torch.bool)
    bricks[0, 1, 2, 0], bricks[1, 0, 0, 1] = True, True
    mask = expand(bricks, 4, (5, 9, 7))
    assert mask.shape == (2, 1, 5, 9, 7)
    assert mask[0, 0, 4:, 8:, :4].all() and mask[1, 0, :4, :4, 4:].all()
    assert mask.sum() == 1 * 1 * 4 + 4 * 4 * 3


@pytest.mark.parametrize("value", [torch.nan, torch.inf])
def test_non_finite_views_are_ignored_as_evidence(value: float):
    world = random_world("cone", 0)
    views = world.views
    views[..., 3, 4] = value
    with pytest.raises(ValueError, match="must be finite, got"):
        kept(world, views)
    with pytest.raises(ValueError, match="last sizes"):
        kept(world, views[0])
    with pytest.raises(ValueError, match="at least 1"):
        kept(world, world.views, 0)
    with pytest.raises(ValueError, match="NaN"):
        kept(world, world.views, threshold=torch.nan)


def test_solids_outside_the_field_of_view_do_not_affect_bricks_inside():
    """A truncated view: the body outside a brick contributes to all footprints, so no brick can be
    removed.
    """
    grid = Grid.centred((8, 8, 8), 1.0)
    rig = parallel(6, {"pixels": [12, 12], "pixel_mm": 1.1}, 400.0)
    slab = Phantom(
        (
            Solids(
                "box",
                torch.zeros(1, 3),
                torch.eye(3)[None],
                torch.full((1, 3), 100.0),
                torch.ones(1),
            ),
        )
    )
    assert kept(World(grid, rig, slab), brick=2).all()


def test_a_body_that_extends_beyond_the_ray_extent_is_kept():
    """The rays end in a ball as wide as a pixel's diagonal, beside the tip of it that lies before
    their end.
    """
    grid = Grid.centred((8, 8, 8), 1.0)
    rig = parallel(
        1, {"pixels": [12, 12], "pixel_mm": 1.0}, 9.01
    )  # along -x, to 0.505 mm beyond the grid
    radius = 0.7075
    centre = torch.tensor([[-3.97 - radius, 0.0, 0.0]])  # half a pixel from four rays
    ball = Phantom(
        (
            Solids(
                "ellipsoid", centre, torch.eye(3)[None], torch.full((1, 3), radius), torch.ones(1)
            ),
        )
    )
    world = World(grid, rig, ball)
    assert ball.values(torch.tensor([-3.98, 0.0, 0.0])) > 0 and not world.views.any()
    stays = kept(world, brick=1)[0]
    assert stays[3:5, 3:5, 0].all()
    assert not stays[:, :, 2:6].any()
