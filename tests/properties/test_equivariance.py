"""The same scene seen otherwise: moved, scaled, stored along other axes, looked at from the other
end.
"""

from dataclasses import replace

import torch
from hypothesis import given, strategies as st
from torch import Tensor

from mvrecon.geometry.cameras.camera import ExplicitRays
from mvrecon.geometry.grid import Grid
from tests.operators.cases import Case
from tests.properties.rays import allowed
from tests.properties.strategies import (
    CUBE,
    DTYPES,
    METHODS,
    ROTATIONS,
    cases,
    radius,
    real,
    vectors,
    volumes,
)

ANY = {"case": cases(), "method": st.sampled_from(METHODS), "data": st.data()}


def check_same(
    views: Tensor, others: Tensor, x: Tensor, *scenes: Case, dtype: torch.dtype = torch.float64
) -> None:
    """Apart by no more than rounding may change in any of the scenes."""
    bounds = [allowed(case, x, dtype) for case in scenes]
    apart, steady = (
        sum(each for each, _ in bounds),
        torch.stack([each for _, each in bounds]).all(dim=0),
    )
    assert ((views - others).abs().double() <= apart)[..., steady].all()


@given(**ANY, R=ROTATIONS, shift=vectors(-10, 10))
def test_views_are_invariant_to_a_joint_motion_of_object_and_cameras(case, method, data, R, shift):
    x, t = data.draw(volumes(case.grid.shape)), shift * radius(case.grid)
    views = case.build(method=method)(x)
    both = Case(case.grid.moved(R, t), case.rays.moved(R, t))
    check_same(both.build(method=method)(x), views, x, case, both)
    object_alone = replace(both, rays=case.rays)
    cameras_back = replace(case, rays=case.rays.moved(R.T, -R.T @ t))
    scenes = object_alone, cameras_back
    check_same(*(each.build(method=method)(x) for each in scenes), x, *scenes)


def scaled(case: Case, s: float) -> Case:
    affine = case.grid.affine.clone()
    affine[:3] *= s
    return replace(
        case.moved(*(s * each for each in case.vectors.values())),
        grid=Grid(case.grid.shape, affine),
    )


@given(**ANY, power=st.integers(-8, 8), s=real(0.01, 100), dtype=st.sampled_from(DTYPES))
def test_views_grow_with_the_scene(case, method, data, power, s, dtype):
    """To the last bit for powers of two, which round nothing."""
    x = data.draw(volumes(case.grid.shape, dtype))
    views, twice = case.build(method=method)(x), scaled(case, 2.0**power).build(method=method)(x)
    exact = views.isfinite() & (views.abs() < 1e35) & ((views.abs() > 1e-34) | (views == 0))
    assert torch.equal((2.0**power * views)[exact], twice[exact])
    larger = scaled(case, s)
    x = x.double()
    check_same(larger.build(method=method)(x) / s, case.build(method=method)(x), x, case)


def stored_along(grid: Grid, x: Tensor, G: Tensor) -> tuple[Grid, Tensor]:
    """The same object with its voxels counted along the axes G of the old ones."""
    source = G.abs().argmax(dim=0).tolist()  # which old axis (x, y, z) each new one runs along
    order = [2 - source[2 - k] for k in range(3)]
    backwards = [2 + k for k in range(3) if G[source[2 - k], 2 - k] < 0]
    y = x.permute(0, 1, *(2 + k for k in order)).flip(backwards)
    affine = grid.affine.clone()
    affine[:3, :3] = affine[:3, :3] @ G
    sizes = torch.tensor(y.shape[:1:-1], dtype=torch.float64)
    affine[:3, 3] = grid.centre - affine[:3, :3] @ ((sizes - 1) / 2)
    return Grid(tuple(y.shape[2:]), affine), y  # type: ignore[arg-type]


@given(**ANY, G=CUBE)
def test_results_do_not_depend_on_the_order_of_axes(case, method, data, G):
    """P5: permuted and flipped."""
    x = data.draw(volumes(case.grid.shape))
    grid, y = stored_along(case.grid, x, G)
    other = replace(case, grid=grid)
    check_same(case.build(method=method)(x), other.build(method=method)(y), x, case, other)


@given(
    case=cases(extents=("segment",)),
    method=st.sampled_from(METHODS),
    data=st.data(),
    dtype=st.sampled_from(DTYPES),
)
def test_a_ray_and_its_reverse_have_the_same_integral(case, method, data, dtype):
    x = data.draw(volumes(case.grid.shape, dtype))
    start, end = (points.contiguous() for points in case.rays.rays())
    ways = [replace(case, rays=ExplicitRays(*each)) for each in ((start, end), (end, start))]
    there, back = (each.build(method=method)(x) for each in ways)
    check_same(there, back, x, case, dtype=dtype)
    check_same(there, case.build(method=method)(x), x, case, dtype=dtype)
