"""The warps against grid_sample at places found by projecting points, and what must hold of any
linear resampling.
"""

from dataclasses import replace

import pytest
import torch

from mvrecon.geometry.cameras.rigs import circular
from mvrecon.geometry.grid import Grid, voxel_centres
from mvrecon.geometry.lattice import (
    depth_edges,
    grid_lattice,
    lattice_maps,
    lifted_maps,
    normalised,
    sample,
)
from mvrecon.kernels.warps import WARP, warp
from mvrecon.methods.learned.view_frames import frusta_lattice
from mvrecon.testing import inner_product_gap
from tests.kernels.warps.scenes import (
    DEPTH,
    OTHER,
    RIGS,
    SMALL,
    bin_centres,
    edges_of,
    generic,
    index_in_frusta,
    lattices,
)
from tests.operators.rigs import CONE, GRID


@pytest.mark.pairwise(kind=RIGS, backend=["cpu", "reference"])
def test_warps_sample_where_projection_says(kind, backend):
    torch.manual_seed(0)
    grid, cameras = RIGS[kind]
    edges = edges_of(grid, cameras)
    frusta, world = lattices(grid, cameras)
    m, bins = len(cameras), bin_centres(cameras, edges)
    x = torch.randn(2, m, 3, *frusta.shape, dtype=torch.float64)
    points = normalised(index_in_frusta(cameras, edges, voxel_centres(grid)), frusta.shape)
    expected = torch.stack([sample(each, points) for each in x])[:, :, None]
    assert torch.allclose(
        warp(x, lattice_maps(frusta, world), grid.shape, backend), expected, atol=1e-9
    )
    y = torch.randn(2, 1, 3, *grid.shape, dtype=torch.float64)
    points = normalised(grid.to_index(bins), grid.shape)
    expected = torch.stack([sample(each.expand(m, -1, -1, -1, -1), points) for each in y])[:, None]
    assert torch.allclose(
        warp(y, lattice_maps(world, frusta), frusta.shape, backend), expected, atol=1e-9
    )
    # pair (s, k): frustum s at the bins of frustum k
    places = index_in_frusta(cameras, edges, bins)
    expected = torch.stack(
        [
            sample(x[:, 1], normalised(places[1, k], frusta.shape).expand(2, -1, -1, -1, -1))
            for k in range(m)
        ]
    )
    pairs = warp(x, lattice_maps(frusta, frusta), frusta.shape, backend)
    assert torch.allclose(pairs[:, 1], expected.transpose(0, 1), atol=1e-7)
    assert expected.abs().max() > 0.1


@pytest.mark.parametrize("kind", RIGS)
def test_warp_back_is_the_transpose(kind):
    torch.manual_seed(0)
    frusta, world = lattices(*RIGS[kind])
    for of, to in ((frusta, world), (world, frusta), (frusta, frusta)):
        maps = lattice_maps(of, to)
        for dtype, tolerance in ((torch.float64, 1e-12), (torch.float32, 1e-5)):
            x = torch.randn(2, len(maps), 2, *of.shape, dtype=dtype)
            Ax = WARP.forward(x, maps, list(to.shape))
            y = torch.randn_like(Ax)
            back = WARP.transpose(y, maps, list(of.shape))
            assert inner_product_gap(x, Ax, y, back) < tolerance
            assert Ax.norm() > 0.1 * x.norm()


def test_threads_change_no_bit(threads, monkeypatch):
    monkeypatch.setattr("mvrecon.kernels.threads.LEAST", 1)
    frusta, world = lattices(GRID, CONE)
    maps = lattice_maps(world, frusta)
    x = torch.randn(1, 1, 2, *GRID.shape)
    y = torch.randn(1, 1, 4, 2, *frusta.shape)
    results = []
    for count in (1, 2, 3, 5):
        threads(count)
        results.append(
            (
                WARP.forward(x, maps, list(frusta.shape)),
                WARP.transpose(y, maps, list(GRID.shape)),
            )
        )
        results[-1] += (WARP.vjp(x, y, maps),)
    for others in results[1:]:
        assert all(torch.equal(one, other) for one, other in zip(results[0], others, strict=True))


@pytest.mark.parametrize("sid", [200.0, 1e6])
@pytest.mark.parametrize(("offset", "voxel"), [(0.0, 1.0), (1e5, 1.0), (0.0, 1e-6), (0.0, 1e6)])
def test_distant_sources_origins_and_scales_lose_no_precision(sid, offset, voxel):
    """The same picture in other units and at another place; a beam from afar is nearly a parallel
    one.
    """
    torch.manual_seed(0)
    detector = {"pixels": [20, 21], "pixel_mm": 1.3 * (1 + 30 / sid)}
    grid, cameras = (
        Grid.centred(size=(22, 20, 18), spacing=(1.0, 1.1, 0.9)),
        circular(3, sid, sid + 30, detector, start_degrees=7.0),
    )
    shift = torch.full((3,), offset, dtype=torch.float64)
    other = {each: voxel * getattr(cameras, each) for each in ("source", "origin", "u", "v")}
    affine = grid.affine.clone()
    affine[:3] *= voxel
    affine[:3, 3] += shift
    moved = replace(cameras, **other).moved(torch.eye(3), shift)
    frusta, world = lattices(grid, cameras)
    far_frusta, far_world = lattices(Grid(grid.shape, affine), moved)
    x = torch.rand(1, 3, 1, *frusta.shape, dtype=torch.float64)
    y = torch.rand(1, 1, 1, *grid.shape, dtype=torch.float64)
    places = index_in_frusta(cameras, edges_of(grid, cameras), voxel_centres(grid))
    exact = sample(x[0], normalised(places, frusta.shape))[None, :, None]
    for dtype, tolerance in ((torch.float64, 1e-7), (torch.float32, 2e-6)):
        got = warp(x.to(dtype), lattice_maps(far_frusta, far_world), grid.shape, "cpu")
        assert (got - exact).norm() < tolerance * exact.norm()
        one = warp(y.to(dtype), lattice_maps(far_world, far_frusta), frusta.shape, "cpu")
        two = warp(y, lattice_maps(world, frusta), frusta.shape, "reference")
        assert (one - two).norm() < tolerance * two.norm()


def test_volumes_beyond_32_bit_indices_use_64_bit_ones(monkeypatch):
    from mvrecon.kernels import rows
    from mvrecon.kernels.warps import cpu as warp_cpu

    assert (
        rows.flat_steps((2**10, 2**11, 2**10)).dtype == "int64"
        and rows.flat_steps(SMALL).dtype == "int32"
    )
    maps = lifted_maps(generic())
    x, y = torch.randn(1, 2, 1, *SMALL), torch.randn(1, 2, 2, 1, *OTHER)
    narrow = warp_cpu.warp(x, maps, OTHER), warp_cpu.warp_transpose(y, maps, SMALL)
    flat_steps = rows.flat_steps
    monkeypatch.setattr(rows, "flat_steps", lambda shape: flat_steps(shape).astype("int64"))
    wide = warp_cpu.warp(x, maps, OTHER), warp_cpu.warp_transpose(y, maps, SMALL)
    assert all(torch.equal(one, other) for one, other in zip(narrow, wide, strict=True))


def test_a_constant_is_preserved_inside_and_zero_outside():
    frusta, world = lattices(GRID, CONE)
    maps = lattice_maps(world, frusta)
    seen = warp(torch.ones(1, 1, 1, *GRID.shape, dtype=torch.float64), maps, frusta.shape, "cpu")[
        0, 0, :, 0
    ]
    index = GRID.to_index(bin_centres(CONE, edges_of(GRID, CONE)))
    sizes = torch.tensor(GRID.shape[::-1])
    inner = ((index > 0) & (index < sizes - 1)).all(dim=-1)
    outer = ((index < -1) | (index > sizes)).any(dim=-1)
    assert inner.any() and outer.any()
    assert torch.allclose(seen[inner], torch.ones_like(seen[inner])) and not seen[outer].any()


def test_the_identity_changes_no_bit():
    maps = lifted_maps(torch.eye(4, dtype=torch.float64)[None, None])
    x = torch.randn(2, 1, 3, *SMALL)
    assert torch.equal(warp(x, maps, SMALL, "cpu")[:, :, 0], x)
    assert torch.equal(WARP.transpose(x[:, :, None], maps, list(SMALL)), x)


def test_points_behind_a_source_are_not_visible():
    """A source inside the grid: its frustum reaches away from it, and no voxel behind it gets
    a value.
    """
    rig = replace(CONE, source=GRID.centre + 0.02 * (CONE.source - GRID.centre))[:1]
    distance = rig.distance[:, None]
    edges = depth_edges(distance * torch.tensor([[0.002, 0.4]], dtype=torch.float64), DEPTH)
    maps = lattice_maps(frusta_lattice(rig, GRID, edges), grid_lattice(GRID))
    shape = (DEPTH, *rig.shape)
    for backend in ("cpu", "reference"):
        seen = warp(torch.ones(1, 1, 1, *shape), maps, GRID.shape, backend)[0, 0, 0, 0]
        behind = rig.project(voxel_centres(GRID))[0, ..., 2] <= 0
        assert behind.any() and seen.any() and not seen[behind].any()


def test_a_linear_ramp_round_trips_exactly():
    """Depth along z is a linear field, which trilinear sampling preserves, so it round trips inside
    the frustum.
    """
    grid = Grid.centred((20, 20, 20), 1.0)
    rig = circular(2, 60.0, 90.0, {"pixels": [40, 40], "pixel_mm": 0.6}, start_degrees=11.0)
    edges = depth_edges(rig.depth_range(grid), 24)
    frusta, world = frusta_lattice(rig, grid, edges), grid_lattice(grid)
    ramp = torch.arange(24, dtype=torch.float64)[:, None, None].expand(1, 2, 1, 24, 40, 40)
    there = warp(ramp, lattice_maps(frusta, world), grid.shape, "cpu")[:, :, 0]
    back = warp(there, lattice_maps(world, frusta).transpose(0, 1), frusta.shape, "cpu")[0, :, 0, 0]
    index = grid.to_index(bin_centres(rig, edges))
    whole = warp(torch.ones_like(ramp), lattice_maps(frusta, world), grid.shape, "cpu")[:, :, 0]
    seen = warp(
        (whole > 1 - 1e-9).double(),
        lattice_maps(world, frusta).transpose(0, 1),
        frusta.shape,
        "cpu",
    )
    inner = ((index > 0) & (index < 19)).all(dim=-1) & (seen[0, :, 0, 0] > 1 - 1e-9)
    assert inner.sum() > 1000
    assert torch.allclose(back[inner], ramp[0, :, 0][inner], atol=1e-9)


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
def test_half_precision_volumes_are_computed_in_float32_and_returned_in_their_dtype(dtype):
    frusta, world = lattices(GRID, CONE)
    x, maps = torch.randn(1, 4, 1, *frusta.shape).to(dtype), lattice_maps(frusta, world)
    assert torch.equal(warp(x, maps, GRID.shape), warp(x.float(), maps, GRID.shape).to(dtype))


def test_inconsistent_sizes_and_unknown_back_ends_are_refused():
    maps = lifted_maps(generic())
    with pytest.raises(ValueError, match="of the same s"):
        warp(torch.zeros(1, 3, 1, *SMALL), maps, OTHER)
    with pytest.raises(ValueError, match="Unknown backend"):
        warp(torch.zeros(1, 2, 1, *SMALL), maps, OTHER, "gpu")
