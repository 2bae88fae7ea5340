"""Voxel-driven back-projection compared with its reference and with geometric facts."""

from dataclasses import replace

import pytest
import torch

from mvrecon.geometry.cameras.rigs import circular, parallel
from mvrecon.geometry.grid import Grid, voxel_centres
from mvrecon.kernels import voxels as voxel_ops
from mvrecon.kernels.voxels.cpu import upright
from mvrecon.operators.voxel_driven import backproject, image_maps
from mvrecon.testing import gap, gradient_gap, inner_product_gap
from tests.operators.rigs import CENTRAL, CONE, GRID, PARALLEL, PINHOLES

EVERY = {**CENTRAL, "parallel": PARALLEL, "line": replace(PARALLEL, extent="line")}


@pytest.mark.pairwise(kind=EVERY, weight=["none", "distance"])
def test_compiled_equals_the_reference_and_its_transpose_is_exact(kind, weight):
    torch.manual_seed(0)
    rig = EVERY[kind]
    maps, window, weighted = image_maps(rig, GRID), list(rig.ray_extent), weight == "distance"
    for dtype, tolerance in ((torch.float64, 1e-12), (torch.float32, 1e-5)):
        y = torch.randn(2, 2, len(rig), *rig.shape, dtype=dtype)
        seen = backproject(y, rig, GRID, weight, "cpu")
        exact = backproject(y, rig, GRID, weight, "reference")
        assert exact.norm() > 0.1 and (seen - exact).norm() < tolerance * exact.norm()
        x = torch.randn_like(seen)
        back = voxel_ops.project(
            x.flatten(0, 1), maps, window, weighted, list(rig.shape)
        ).unflatten(0, (2, 2))
        assert inner_product_gap(y, seen, x, back) < tolerance


TALL = Grid.centred(size=(19, 5, 12), spacing=(1.0, 1.2, 0.9))
WIDE = {"pixels": [11, 12], "pixel_mm": [1.6, 2.0], "offset_mm": [1.4, -3.3]}
UPRIGHT = {
    "cone": circular(5, 40.0, 70.0, WIDE, start_degrees=13.0),
    "inside": circular(4, 6.0, 30.0, WIDE),
    "parallel": parallel(4, WIDE, 60.0, start_degrees=11.0),
    "upside down": circular(5, 40.0, 70.0, WIDE).moved(
        torch.diag(torch.tensor([1.0, -1.0, -1.0])), torch.zeros(3)
    ),
    "far rows": circular(3, 40.0, 70.0, {**WIDE, "offset_mm": [12.0, 0.0]}),
}


@pytest.mark.pairwise(1, kind=UPRIGHT, weight=["none", "distance"])
def test_upright_columns_equal_the_reference_and_their_transpose_is_exact(kind, weight):
    """Alone, and beside a tilted view that is looked up row by row."""
    torch.manual_seed(0)
    rig, tilt = UPRIGHT[kind], UPRIGHT[kind].v[-1:] + 0.02 * UPRIGHT[kind].u[-1:]
    assert upright(image_maps(rig, TALL).numpy(), TALL.shape).all()
    mixed = replace(rig, v=torch.cat([rig.v[:-1], tilt]))
    assert upright(image_maps(mixed, TALL).numpy(), TALL.shape).tolist()[-2:] == [True, False]
    for cameras in (rig, mixed):
        for dtype, tolerance in ((torch.float64, 1e-12), (torch.float32, 2e-6)):
            y = torch.randn(2, 1, len(rig), *rig.shape, dtype=dtype)
            seen = backproject(y, cameras, TALL, weight, "cpu")
            exact = backproject(y, cameras, TALL, weight, "reference")
            assert exact.norm() > 0.1 and (seen - exact).norm() < tolerance * exact.norm()
        x = torch.randn(2, *TALL.shape, dtype=torch.float64)
        arguments = list(rig.ray_extent), weight == "distance", list(rig.shape)
        back = voxel_ops.project(x, image_maps(cameras, TALL), *arguments)
        seen = backproject(y.double(), cameras, TALL, weight, "cpu")[:, 0]
        assert inner_product_gap(y[:, 0], seen, x, back) < 1e-12


@pytest.mark.parametrize("rig", [CONE, PINHOLES, PARALLEL], ids=["cone", "pinholes", "parallel"])
def test_a_linear_view_is_sampled_at_the_projected_voxel(rig):
    u = torch.arange(rig.shape[1], dtype=torch.float64)
    view = u + 10 * torch.arange(rig.shape[0], dtype=torch.float64)[:, None]
    seen = backproject(view.expand(1, 1, 1, *rig.shape), rig[:1], GRID)[0, 0]
    uvz = rig[:1].project(voxel_centres(GRID))[0]
    inner = ((uvz[..., :2] > 0) & (uvz[..., :2] < torch.tensor(rig.shape[::-1]) - 1)).all(dim=-1)
    assert inner.sum() > 20
    assert torch.allclose(seen[inner], (uvz[..., 0] + 10 * uvz[..., 1])[inner])


def test_one_pixel_back_projects_to_the_cone_through_it():
    grid = Grid.centred((21, 21, 21), 1.0)
    rig = circular(3, 60.0, 90.0, {"pixels": [31, 31], "pixel_mm": 1.5}, start_degrees=17.0)
    views = torch.zeros(1, 1, 3, 31, 31, dtype=torch.float64)
    uv = rig.project(torch.tensor([3.0, -2.0, 4.0]))[..., :2].round().long()
    for m, (u, v) in enumerate(uv.tolist()):
        views[0, 0, m, v, u] = 1
    seen = backproject(views, rig, grid)[0, 0]
    off = (rig.project(voxel_centres(grid))[..., :2] - uv[:, None, None, None]).abs()
    assert torch.allclose(seen, (1 - off).clamp_min(0).prod(dim=-1).sum(dim=0))
    assert (
        seen.argmax()
        == (voxel_centres(grid) - torch.tensor([3.0, -2.0, 4.0])).norm(dim=-1).argmin()
    )


def test_the_weight_of_a_uniform_view_is_the_square_of_magnification():
    grid = Grid.centred((8, 8, 8), 2.0)
    rig = circular(1, 60.0, 90.0, {"pixels": [40, 40], "pixel_mm": 2.0}, start_degrees=20.0)
    ones = torch.ones(1, 1, 1, 40, 40, dtype=torch.float64)
    z = (voxel_centres(grid) - rig.source[0]) @ torch.nn.functional.normalize(-rig.source[0], dim=0)
    feldkamp = (60.0 / z) ** 2
    assert torch.allclose(
        backproject(ones, rig, grid, "distance")[0, 0] * (60.0 / 90.0) ** 2, feldkamp
    )
    beam = parallel(1, {"pixels": [40, 40], "pixel_mm": 2.0}, 90.0)
    assert (backproject(ones, beam, grid, "distance") == 1).all()


@pytest.mark.parametrize("sid", [60.0, 1e6])
@pytest.mark.parametrize(("offset", "voxel"), [(1e5, 1.0), (0.0, 1e-6), (0.0, 1e6)])
def test_distant_sources_origins_and_scales_lose_no_precision(sid, offset, voxel):
    torch.manual_seed(0)
    shift = torch.full((3,), offset, dtype=torch.float64)
    grid = Grid.centred(size=(22, 20, 18), spacing=(1.0, 1.1, 0.9))
    rig = circular(3, sid, sid + 30, {"pixels": [20, 21], "pixel_mm": 1.3}, start_degrees=7.0)
    scaled = replace(
        rig, **{each: voxel * getattr(rig, each) for each in ("source", "origin", "u", "v")}
    )
    other = Grid.centred(
        size=grid.size, spacing=[voxel * mm for mm in grid.spacing], centre=shift.tolist()
    )
    y = torch.rand(1, 1, 3, 20, 21, dtype=torch.float64)
    exact = backproject(y, rig, grid, "distance", "reference")
    for dtype, tolerance in ((torch.float64, 1e-8), (torch.float32, 2e-6)):
        seen = backproject(y.to(dtype), scaled.moved(torch.eye(3), shift), other, "distance", "cpu")
        assert (seen - exact).norm() < tolerance * exact.norm()


def test_voxels_outside_the_ray_extent_are_zero():
    """Behind the source of a cone, and behind the detector of a segment."""
    source = GRID.centre + 0.02 * (CONE.source - GRID.centre)
    rig = replace(
        CONE,
        source=source,
        origin=source + 0.06 * (CONE.origin - source),
        u=CONE.u / 5,
        v=CONE.v / 5,
    )[:1]
    seen = backproject(torch.ones(1, 1, 1, *rig.shape), rig, GRID)[0, 0]
    z = rig.project(voxel_centres(GRID))[0, ..., 2]
    off = (z <= 0) | (z >= rig.distance)
    assert (z <= 0).any() and (z >= rig.distance).any() and seen.any() and not seen[off].any()


def test_gradients_in_views_and_cameras():
    rig, grid = CONE[:2], Grid.centred(size=(2, 3, 2), spacing=1.3, centre=GRID.centre.tolist())
    y = torch.randn(1, 1, 2, *rig.shape, dtype=torch.float64, requires_grad=True)
    assert gradient_gap(lambda y: backproject(y, rig, grid, "distance", "cpu"), y) < 1e-6
    assert torch.autograd.gradgradcheck(
        lambda y: backproject(y, rig, grid, "distance", "cpu") ** 2, (y,)
    )

    def moved(source, backend="cpu"):
        return backproject(y.detach(), replace(rig, source=source), grid, "distance", backend)

    source = rig.source.clone().requires_grad_()
    assert gradient_gap(moved, source) < 1e-6
    slopes = [
        torch.autograd.grad(moved(source, backend).square().sum(), source)[0]
        for backend in ("cpu", "reference")
    ]
    assert slopes[1].norm() > 0.1 and gap(*slopes) < 1e-12


def test_torch_accepts_the_operators_and_compiles_and_maps_them():
    maps, window, shape = image_maps(CONE, GRID), list(CONE.ray_extent), list(GRID.shape)
    y = torch.randn(2, 4, *CONE.shape, dtype=torch.float64, requires_grad=True)
    x = torch.randn(2, *GRID.shape, dtype=torch.float64, requires_grad=True)
    checks = ("test_schema", "test_autograd_registration", "test_faketensor")
    torch.library.opcheck(
        torch.ops.mvrecon.voxel_backproject.default,
        (y, maps, window, True, shape),
        test_utils=checks,
    )
    torch.library.opcheck(
        torch.ops.mvrecon.voxel_project.default,
        (x, maps, window, True, list(CONE.shape)),
        test_utils=checks,
    )
    mapped = torch.func.vmap(
        lambda y: voxel_ops.backproject(y, maps, window, True, shape), in_dims=1
    )
    several = torch.randn(2, 3, 4, *CONE.shape)
    one = voxel_ops.backproject(several[:, 1], maps, window, True, shape)
    assert torch.equal(mapped(several)[1], one)
    compiled = torch.compile(
        lambda y: voxel_ops.backproject(2 * y, maps, window, True, shape),
        fullgraph=True,
        backend="aot_eager",
    )
    assert torch.equal(compiled(several[:, 1] / 2), one)


def test_threads_change_no_bit(monkeypatch):
    monkeypatch.setattr("mvrecon.kernels.threads.LEAST", 1)
    y, x, before = (
        torch.randn(1, 2, 4, *CONE.shape),
        torch.randn(2, *GRID.shape),
        torch.get_num_threads(),
    )
    maps, window, results = image_maps(CONE, GRID), list(CONE.ray_extent), []
    for count in (1, 2, 3, 7):
        torch.set_num_threads(count)
        back = voxel_ops.project(x, maps, window, True, list(CONE.shape))
        results.append((backproject(y, CONE, GRID, "distance", "cpu"), back))
        tall = torch.linspace(0, 1, 4 * 11 * 12).sin().reshape(1, 1, 4, 11, 12)
        results[-1] += (backproject(tall, UPRIGHT["cone"][:4], TALL, "distance", "cpu"),)
    torch.set_num_threads(before)
    for seen, back, columns in results[1:]:
        assert torch.equal(columns, results[0][2])
        assert torch.equal(seen, results[0][0]) and torch.equal(back, results[0][1])


def test_invalid_arguments_are_refused():
    with pytest.raises(ValueError, match="Known: none, distance"):
        backproject(torch.zeros(1, 1, 4, *CONE.shape), CONE, GRID, "inverse")  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="Expected views"):
        backproject(torch.zeros(1, 1, 3, *CONE.shape), CONE, GRID)
