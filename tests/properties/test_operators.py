"""What makes an operator linear, matched to its adjoint and positive, on any geometry and for
values of any size.
"""

import pytest
import torch
from hypothesis import given, strategies as st

from mvrecon.geometry.cameras.camera import Cameras, ExplicitRays
from mvrecon.geometry.grid import Grid
from mvrecon.testing import inner_product_gap
from tests.operators.cases import Case
from tests.properties.rays import allowed
from tests.properties.strategies import DTYPES, METHODS, SEEDS, cases, epsilon, real, volumes

ADJOINT = {torch.float32: 1e-5, torch.float64: 1e-12}
ANY = {
    "case": cases(),
    "method": st.sampled_from(METHODS),
    "dtype": st.sampled_from(DTYPES),
    "data": st.data(),
}


def noise(shape, seed: int, dtype: torch.dtype) -> torch.Tensor:
    return torch.randn(
        shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64
    ).to(dtype)


@given(**ANY, rays=st.sampled_from([1, 1, 2]), seed=SEEDS)
def test_the_adjoint_is_the_transpose(case, method, dtype, data, rays, seed):
    """To 1e-5 and 1e-12 of what the products would be if nothing cancelled: of |y| . A |x|."""
    A = case.build(method=method, rays_per_pixel=rays)
    x = data.draw(volumes(case.grid.shape, dtype))
    y = noise(A(x).shape, seed, dtype)
    whole = (A(x.abs()).double() * y.double().abs()).sum()
    assert inner_product_gap(x, A(x), y, A.T(y), whole) <= ADJOINT[dtype]


def beside_nothing(away: float, shape: tuple[int, int]) -> tuple[Case, torch.Tensor]:
    """Rays that run level a little before slice 6, which is empty; slice 5 is not, and weighs that
    little.
    """
    z = 0.5 - away
    source, origin, u, v = (
        [0.1, -20.0, z],
        [0.1, 20.0, z],
        [-0.1, 0.0, 0.0],
        [0.0, 0.0, 1e-3 * away],
    )
    cameras = Cameras(
        *(torch.tensor([each], dtype=torch.float64) for each in (source, origin, u, v)), shape=shape
    )
    x = torch.zeros(1, 1, 12, 5, 5, dtype=torch.float64)
    x[:, :, 5] = (
        torch.rand(5, 5, generator=torch.Generator().manual_seed(0), dtype=torch.float64) + 0.1
    )
    return Case(Grid.centred(size=(5, 5, 12), spacing=1.0), cameras), x


@pytest.mark.pairwise(method=["joseph", "trilinear"], shape=[(9, 3), (1, 3)], channels=[1, 4])
def test_weights_near_zero_are_the_same_in_the_transpose(method, shape, channels):
    """Shrunk: to rounding errors of the weights themselves, not of the empty voxel that has nearly
    all the weight.
    """
    for dtype, away in ((torch.float32, 1e-5), (torch.float64, 1e-12)):
        case, x = beside_nothing(away, shape)
        x, A = x.to(dtype).expand(1, channels, -1, -1, -1).contiguous(), case.build(method=method)
        views, y = A(x), noise((1, channels, 1, *shape), 0, dtype)
        assert (views > 0).all() and (views < 10 * away).all()
        whole = (views.double() * y.double().abs()).sum()
        assert inner_product_gap(x, views, y, A.T(y), whole) <= 20 * epsilon(dtype)


@given(**ANY, a=real(-10, 10), b=real(-10, 10))
def test_sums_and_multiples(case, method, dtype, data, a, b):
    A = case.build(method=method)
    x, y = (data.draw(volumes(case.grid.shape, dtype))[:, :1] for _ in range(2))
    size = abs(a) * A(x.abs()) + abs(b) * A(y.abs())
    # a cell is interpolated to some rounding errors of the greatest value in it, however little
    # that weighs
    most = (abs(a) * x.abs().max() + abs(b) * y.abs().max()) * A(torch.ones_like(x))
    apart = (A(a * x + b * y) - (a * A(x) + b * A(y))).abs()
    assert (apart.double() <= 100 * epsilon(dtype) * (size.double() + most.double())).all()
    assert not A(0 * x).any()


@given(**ANY)
def test_non_negative_input_gives_non_negative_output(case, method, dtype, data):
    A = case.build(method=method)
    x = data.draw(volumes(case.grid.shape, dtype, signed=False))
    views = A(x)
    assert (views >= 0).all() and views.isfinite().all()
    volume = A.T(torch.rand(views.shape, generator=torch.Generator().manual_seed(1)).to(dtype))
    assert (volume >= 0).all() and volume.isfinite().all()
    more = A(2 * x + x.amax())
    assert (more >= views * (1 - 100 * epsilon(dtype))).all()


@given(**ANY, seed=SEEDS)
def test_a_duplicate_view_counts_twice(case, method, dtype, data, seed):
    """P14: the same bits in both, and twice as much in the adjoint."""
    A = case.build(method=method)
    x = data.draw(volumes(case.grid.shape, dtype))
    m = len(case.rays)
    twice = case.moved(*[torch.cat([each, each]) for each in case.vectors.values()]).build(
        method=method
    )
    views = A(x)
    assert torch.equal(twice(x), torch.cat([views, views], dim=2))
    y = noise(views.shape, seed, dtype)
    both, one = twice.T(torch.cat([y, y], dim=2)), A.T(y)
    assert both.shape == one.shape and twice(x).shape[2] == 2 * m
    assert ((both - 2 * one).abs() <= 100 * epsilon(dtype) * A.T(y.abs())).all()


@given(**ANY)
def test_the_compiled_loops_and_the_reference_agree(case, method, dtype, data):
    """They share no arithmetic. In float32 the compiled ones keep a ray's place in float64 until
    the last step.
    """
    x = data.draw(volumes(case.grid.shape, dtype))
    views, oracle = (
        case.build(method=method, backend=backend)(x) for backend in ("cpu", "reference")
    )
    apart, steady = allowed(case, x, dtype)
    assert ((views - oracle).abs().double() <= apart)[..., steady].all()


@pytest.mark.parametrize("backend", ["cpu", "reference"])
@pytest.mark.parametrize("method", METHODS)
def test_a_ray_that_starts_on_a_face_ignores_voxels_behind_it(method, backend):
    """Shrunk: rounding gave it a slab too many, of a length below zero."""
    grid = Grid.centred(size=(2, 1, 1), spacing=1.0)
    x = torch.tensor([1.0, 0.0], dtype=torch.float64).reshape(1, 1, 1, 1, 2)
    for near, far in ((1e-17, 0.9), (-1e-17, -0.9)):
        ends = torch.tensor([[near, 0.0, 0.0], [far, 0.0, 0.0]], dtype=torch.float64).reshape(
            2, 1, 1, 1, 3
        )
        views = Case(grid, ExplicitRays(*ends)).build(method=method, backend=backend)(
            x if far > 0 else x.flip(4)
        )
        assert (views >= 0).all() and (method == "trilinear" or not views.any())
