"""Total variation: its gradient, its proximal map, and the two methods that minimise it."""

from functools import cache

import pytest
import torch

from mvrecon.geometry.cameras.rigs import circular
from mvrecon.geometry.grid import Grid
from mvrecon.kernels.differences import Shrinkage, gradient, gradient_adjoint
from mvrecon.methods.classical.sirt import WeightedFit, sirt
from mvrecon.methods.classical.total_variation import (
    fista_tv,
    pdhg_tv,
    power_norm,
    total_variation,
    tv_proximal,
    voxel_steps,
)
from mvrecon.testing import inner_product_gap
from tests.methods.classical.methods import Dense, gap, tabulated

STEPS = (1.5, 2.0, 0.5)


@torch.no_grad()
def tv_objective(A, views, volume, weight):
    """What `fista_tv` and `pdhg_tv` minimise: |y - A x|^2_R / (2 c) + weight sum |D x|."""
    fit = WeightedFit.of(A, volume.dtype)
    return fit(views - A(volume)) + weight * total_variation(volume, voxel_steps(A))


@cache
def slice_operator(views: int = 8, size: int = 24):
    """A square slice and a fan of few views."""
    grid = Grid.centred(size=(size, size, 1), spacing=2.0)
    rig = circular(views, 200.0, 400.0, {"pixels": [1, 40], "pixel_mm": 3.0})
    return tabulated(grid, rig)


@pytest.fixture
def blocks():
    """A volume of constant pieces."""
    x = torch.zeros(1, 1, 1, 24, 24, dtype=torch.float64)
    x[..., 6:17, 8:15] = 1
    x[..., 9:12, 10:13] = 0.5
    return x


def test_the_gradient_of_a_ramp_is_its_slope_with_an_exact_transpose():
    torch.manual_seed(0)
    axes = [torch.arange(n, dtype=torch.float64) for n in (4, 5, 6)]
    z, y, x = torch.meshgrid(*axes, indexing="ij")
    slope = 3 * STEPS[0] * z - 2 * STEPS[1] * y + 7 * STEPS[2] * x
    g = gradient(slope[None, None], STEPS)
    inner = g[..., :-1, :-1, :-1].flatten(1)
    assert torch.allclose(inner, torch.tensor([[3.0], [-2.0], [7.0]], dtype=torch.float64))
    assert not g[0, ..., -1, :, :].any() and not g[2, ..., -1].any()
    v, p = torch.randn(2, 1, 4, 5, 6, dtype=torch.float64), torch.randn(3, 2, 1, 4, 5, 6).double()
    assert inner_product_gap(v, gradient(v, STEPS), p, gradient_adjoint(p, STEPS)) < 1e-12


def test_the_total_variation_of_a_block_is_its_surface_times_its_height():
    """But for the corner's voxels, where the root of three squares is taken; per voxel's volume."""
    x = torch.zeros(1, 1, 12, 12, 12, dtype=torch.float64)
    x[..., 2:10, 3:9, 4:8] = 2.5
    z, y, u = 8 * STEPS[0], 6 * STEPS[1], 4 * STEPS[2]
    surface = 2 * (z * y + y * u + z * u)
    voxel = STEPS[0] * STEPS[1] * STEPS[2]
    value = total_variation(x, STEPS).item() * voxel
    assert 0.9 * 2.5 * surface < value <= 2.5 * surface


@pytest.mark.parametrize("nonnegative", [True, False])
def test_the_proximal_map_closes_its_duality_gap(nonnegative):
    """Primal value less dual value of |x - z|^2 / (2 s) + |D x| falls to zero, for a strength s of
    its own in every voxel, and at a strength of zero a voxel stays.
    """
    torch.manual_seed(0)
    z = torch.randn(2, 1, 5, 6, 7, dtype=torch.float64)
    strength = 0.1 + torch.rand(1, 1, 5, 6, 7, dtype=torch.float64)
    shrinkage = Shrinkage(strength, STEPS, nonnegative)
    gaps = []
    for iterations in (10, 100, 1000):
        dual = torch.zeros(3, *z.shape, dtype=torch.float64)
        x, p = tv_proximal(z, shrinkage, dual, iterations)
        assert torch.linalg.vector_norm(p, dim=0).max() <= 1 + 1e-12
        primal = ((x - z).square() / (2 * strength)).sum() + total_variation(x, STEPS).sum()
        # the minimum over x of |x - z|^2 / (2 s) + <p, D x>, a lower bound for every p in the balls
        bound = ((x - z).square() / (2 * strength)).sum() + (p * gradient(x, STEPS)).sum()
        gaps.append(((primal - bound) / primal).item())
    assert gaps[0] > gaps[1] > gaps[2] >= -1e-12 and gaps[2] < 1e-4
    strength[..., 2, 3, 4] = 0
    x, _ = tv_proximal(z, shrinkage, torch.zeros(3, *z.shape, dtype=torch.float64), 50)
    expected = z[..., 2, 3, 4].clamp_min(0) if nonnegative else z[..., 2, 3, 4]
    assert torch.equal(x[..., 2, 3, 4], expected)


def test_two_voxels_approach_each_other_by_the_strength():
    """The closed form: a step of height h becomes h - 2 s / step, or vanishes."""
    for height, after in ((4.0, 2.0), (1.0, 0.0)):
        z = torch.tensor([0.0, height], dtype=torch.float64).reshape(1, 1, 1, 1, 2)
        strength = torch.full((1, 1, 1, 1, 1), 2.0, dtype=torch.float64)
        dual = torch.zeros(3, *z.shape, dtype=torch.float64)
        x, _ = tv_proximal(z, Shrinkage(strength, (1.0, 1.0, 2.0), False), dual, 200)
        assert torch.allclose(x.diff().squeeze(), torch.tensor(after).double(), atol=1e-5)
        assert torch.allclose(x.mean(), z.mean())


def test_total_variation_recovers_piecewise_constants_from_few_views_and_sirt_does_not(blocks):
    A = slice_operator(7)
    y = A(blocks)
    plain = gap(sirt(A, y, 300, momentum=True), blocks)
    assert gap(fista_tv(A, y, 200, 1e-4), blocks) < 0.3 * plain


def test_for_exact_views_the_error_is_proportional_to_the_weight(blocks):
    """Each weight starts from the minimum of the one before."""
    A, truth, errors = slice_operator(views=12, size=16), blocks[..., 4:20, 4:20], []
    x = torch.zeros_like(truth)
    for weight in (1e-3, 1e-4, 1e-5):
        x = fista_tv(A, A(truth), iterations=60, weight=weight, start=x)
        errors.append(float((x - truth).norm() / truth.norm()))
    assert errors[2] == pytest.approx(errors[1] / 10, rel=0.1)


def test_all_algorithms_find_the_same_minimum(blocks):
    torch.manual_seed(0)
    A, blocks, weight = slice_operator(size=14), blocks[..., 4:18, 4:18], 3e-3
    y = A(blocks)
    y = y + 0.01 * y.max() * torch.randn_like(y)
    ways = [
        fista_tv(A, y, 100, weight, inner=10),
        fista_tv(A, y, 100, weight, inner=10, preconditioned=False),
        pdhg_tv(A, y, 500, weight, balance=0.2),
    ]
    values = torch.stack([tv_objective(A, y, x, weight).squeeze() for x in ways])
    assert (values.max() - values.min()) / values.min() < 1e-3
    for x in ways[1:]:
        assert gap(x, ways[0]) < 1e-3
    # no small change of the volume is better
    least = values.min()
    for change in (blocks, torch.ones_like(blocks), torch.randn_like(blocks)):
        for size in (1e-2, -1e-2):
            other = (ways[0] + size * change).clamp_min(0)
            assert tv_objective(A, y, other, weight) > least


@pytest.mark.parametrize("nonnegative", [True, False])
def test_the_duality_gap_bounds_the_distance_from_the_minimum_and_stops_the_run(
    blocks, nonnegative
):
    torch.manual_seed(0)
    A, weight = slice_operator(size=14), 3e-3
    y = A(torch.cat([blocks, 0.2 * blocks.flip(3)])[..., 4:18, 4:18])
    y = y + 0.01 * y.max() * torch.randn_like(y)
    options = {"weight": weight, "nonnegative": nonnegative}
    least = tv_objective(A, y, pdhg_tv(A, y, 1500, **options), weight)
    seen = []

    def monitor(iterate):
        if iterate.gap is not None:
            value = tv_objective(A, y, iterate.volume, weight)
            assert (iterate.gap >= 1 - least / value - 1e-7).all()
            seen.append((iterate.number, iterate.gap))

    x = pdhg_tv(A, y, 800, gap=1e-3, monitor=monitor, **options)
    assert seen[-1][0] < 700 and (1 - least / tv_objective(A, y, x, weight)).max() < 1e-3
    ends = [next(n for n, gap in seen if gap[k] <= 1e-3) for k in range(2)]
    assert ends[0] != ends[1] and seen[-1][0] == max(ends)
    for k, number in enumerate(ends):
        assert gap(x[k], pdhg_tv(A, y[k : k + 1], number, **options)[0]) < 1e-9


def test_total_variation_within_a_support_closes_its_gap(blocks):
    A, gaps = slice_operator(), []
    support = blocks[0, 0] > 0
    support[:, 5:18, 7:16] = True
    y = A(blocks) + 0.01

    def monitor(iterate):
        if iterate.gap is not None:
            gaps.append(iterate.gap.item())

    x = pdhg_tv(A, y, 400, 1e-2, support=support, monitor=monitor)
    assert not x[..., ~support].any() and gaps[-1] < 1e-2 < gaps[0]


def test_the_weight_means_the_same_on_every_rig(blocks):
    """The data term of the same error hardly depends on the number of views and pixels."""
    error, values = blocks.roll(3, 3) - 0.3 * blocks, []
    for views in (8, 16, 32):
        A = slice_operator(views)
        values.append(WeightedFit.of(A, torch.float64)(A(error)).item())
    assert max(values) < 1.1 * min(values)


def test_the_power_method_converges_to_the_norm_from_below():
    A = Dense()
    exact = torch.linalg.svdvals(A.matrix)[0].item()
    few, many = (power_norm(A, n, torch.float64) for n in (3, 30))
    assert few <= many <= exact * (1 + 1e-12) and many > 0.999 * exact
