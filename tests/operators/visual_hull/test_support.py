"""The support of a case: kinds, and rejected input."""

import warnings
from dataclasses import replace

import pytest
import torch

from mvrecon.data.scenes.solids import Phantom, Solids, voxelise
from mvrecon.geometry.cameras.camera import ExplicitRays
from mvrecon.geometry.cameras.rigs import parallel
from mvrecon.geometry.grid import Box, Grid
from mvrecon.geometry.rigid import random_rotation
from mvrecon.operators.visual_hull.hull import expand, thin_witnesses, visual_hull
from mvrecon.operators.visual_hull.support import (
    brick_edge,
    noise_threshold,
    support_from_views,
)
from tests.operators.visual_hull.cases import World, random_world

SMALL, LARGE = (
    random_world("pinholes", 4),
    random_world("inside", 0),
)  # a hull of a part, and of nearly all of the grid


def of(world: World, kind: str = "auto", **options):
    return support_from_views(world.views, world.cameras, world.grid, kind, **options)


def test_a_hull_is_a_mask_of_bricks_that_contains_the_object():
    support = of(SMALL, "hull", brick=2)
    assert support.mask is not None
    assert torch.equal(
        support.mask,
        expand(visual_hull(SMALL.views, SMALL.cameras, SMALL.grid, 2), 2, SMALL.grid.shape),
    )
    assert support.box == Box.around(support.mask)
    assert support.fraction == pytest.approx(support.mask.double().mean().item())
    assert not ((voxelise(SMALL.phantom, SMALL.grid, 3) > 0) & ~support.mask[0, 0]).any()


def test_the_box_of_a_hull_has_no_mask():
    hull, box = of(SMALL, "hull"), of(SMALL, "box")
    assert box.mask is None and box.kind == "box" and box.box == hull.box
    assert box.fraction == pytest.approx(
        box.box.size / torch.tensor(SMALL.grid.shape).prod().item()
    )
    assert hull.fraction < box.fraction < 1


def test_no_support_is_the_full_grid_without_inspecting_views():
    support = support_from_views(
        torch.full_like(SMALL.views, torch.nan), SMALL.cameras, SMALL.grid, "none"
    )
    assert (support.box, support.mask, support.fraction) == (Box.whole(SMALL.grid.shape), None, 1.0)


def test_auto_uses_the_hull_only_if_its_box_is_smaller_than_the_grid():
    assert of(SMALL).kind == "hull"
    assert torch.equal(of(SMALL).mask, of(SMALL, "hull").mask)
    assert of(LARGE, "box").fraction > 0.7
    assert (
        of(LARGE).kind == "none"
        and of(LARGE).mask is None
        and of(LARGE).box == Box.whole(LARGE.grid.shape)
    )


def test_a_box_contains_the_hulls_of_all_items_of_a_batch():
    views = torch.cat([SMALL.views, SMALL.views.flip(-1)])
    support = support_from_views(views, SMALL.cameras, SMALL.grid, "hull")
    alone = [support_from_views(item[None], SMALL.cameras, SMALL.grid, "hull") for item in views]
    masks = torch.cat([item.mask for item in alone])
    assert support.box == Box.around(masks) and torch.equal(support.mask, masks)


def test_zero_views_give_an_empty_mask_in_one_central_brick():
    grid, views = Grid.centred((9, 9, 9), 1.0), torch.zeros_like(SMALL.views)
    rig = SMALL.cameras.moved(torch.eye(3), -SMALL.grid.centre)
    support = support_from_views(views, rig, grid, "auto", brick=2)
    assert support.kind == "hull" and support.fraction == 0 and not support.mask.any()
    assert support.box == Box((4, 4, 4), (6, 6, 6))
    assert grid.cropped(support.box).shape == (2, 2, 2)
    assert support_from_views(views, rig, grid, "box", brick=2).box == support.box


def test_the_noise_model_determines_the_test_for_emptiness():
    edge, shape = brick_edge(SMALL.grid), SMALL.grid.shape
    noisy = of(SMALL, "hull", noise={"photons": 1e4, "witnesses": 2})
    bricks = visual_hull(
        SMALL.views, SMALL.cameras, SMALL.grid, edge, noise_threshold(SMALL.views, 1e4), 2
    )
    assert torch.equal(noisy.mask, expand(bricks, edge, shape))
    for unknown in (
        {"photon": 1e5},
        {"witness": 1},
        {"photons": 1e5, "tolerance": 1.0},
        {"tolerance": 1.0},
    ):
        with pytest.raises(ValueError, match="got \\['"):
            of(SMALL, noise=unknown)


@pytest.mark.parametrize("kind", ["auto", "hull", "box"])
def test_a_support_requires_finite_views_of_cameras(kind: str):
    with pytest.raises(ValueError, match="must be finite, got 1 of"):
        views = SMALL.views
        views[0, 0, 1, 2, 3] = torch.nan
        support_from_views(views, SMALL.cameras, SMALL.grid, kind)
    rays = ExplicitRays(*SMALL.cameras.rays())
    with pytest.raises(ValueError, match="explicit rays"):
        support_from_views(SMALL.views, rays, SMALL.grid, kind)
    assert support_from_views(SMALL.views, rays, SMALL.grid, "none").mask is None
    with pytest.raises(ValueError, match="Known: auto, hull, box, none"):
        of(SMALL, "hulls")


@pytest.mark.parametrize(
    ("longest", "edge"), [(5, 1), (48, 1), (64, 2), (128, 4), (256, 8), (512, 8)]
)
def test_bricks_are_fine_on_small_grids(longest: int, edge: int):
    assert brick_edge(Grid.centred(size=(4, longest, 3), spacing=1.0)) == edge


def rods(pixel: float) -> World:
    """Four rods of 1 mm, each turned its own way, in voxels of 1 mm, seen by 40 parallel views."""
    rng = torch.Generator().manual_seed(4)
    grid, rig = (
        Grid.centred((24, 24, 24), 1.0),
        parallel(40, {"pixels": [24, 24], "pixel_mm": pixel}, 90.0),
    )
    centres = 8 * torch.rand(4, 3, generator=rng, dtype=torch.float64) - 4
    sizes = torch.tensor([[0.5, 0.5, 5.0]] * 4, dtype=torch.float64)
    return World(
        grid,
        rig,
        Phantom((Solids("cylinder", centres, random_rotation(rng, 4), sizes, torch.ones(4)),)),
    )


def test_a_tenth_of_many_views_must_agree_so_that_thin_rods_remain():
    """Rods of half a pixel pass between the rays of some views: one view is no proof for them, four
    of 40 are.
    """
    world = rods(2.0)
    thin = voxelise(world.phantom, world.grid, 4) > 0
    one, tenth = (of(world, "hull", noise=noise).mask for noise in ({"witnesses": 1}, None))
    assert torch.equal(
        tenth[0, 0], visual_hull(world.views, world.cameras, world.grid, 1, witnesses=4)[0]
    )
    assert (thin & ~one[0, 0]).any()
    assert not (thin & ~tenth[0, 0]).any()
    assert tenth.float().mean() < 0.5
    assert [thin_witnesses(n) for n in (1, 8, 19, 20, 80)] == [1, 1, 1, 2, 8]


def test_voxels_smaller_than_the_ray_spacing_raise_a_warning():
    """A hull warns, with the ray spacing, if objects of one voxel can pass between rays."""
    with pytest.warns(
        UserWarning, match=r"up to 2.83 mm apart .*, voxels are 1 mm: .* thinner than 2.83 mm"
    ):
        of(rods(2.0), "hull")
    fine = rods(0.7)  # a diagonal of 0.99 mm
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        of(fine, "hull")
        of(replace(fine, cameras=rods(2.0).cameras), "none")
