"""Subsets and the whole: bricks add up, empty voxels can be skipped, selected rays match the full
operator.
"""

from dataclasses import replace

import pytest
import torch
from hypothesis import given, strategies as st

from mvrecon.geometry.grid import Box
from mvrecon.kernels.rays.cpu import skip_policy
from mvrecon.operators.selection import ray_subset, view_subset
from mvrecon.testing import skip_gap
from tests.operators.cases import CASES
from tests.properties.rays import allowed
from tests.properties.strategies import DTYPES, METHODS, SEEDS, cases, epsilon, volumes

ANY = {
    "case": cases(),
    "method": st.sampled_from(METHODS),
    "dtype": st.sampled_from(DTYPES),
    "data": st.data(),
}


@pytest.fixture(autouse=True, scope="module")
def nothing_is_too_little():
    """Small volumes are looked at, too."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(skip_policy, "SOME", 0)
        patch.setattr(skip_policy, "MUCH", 0)
        yield


def masks(seed: int, shape, share: float) -> torch.Tensor:
    return torch.rand(shape, generator=torch.Generator().manual_seed(seed)) < share


@given(**ANY, cuts=st.tuples(*[st.floats(0, 1)] * 3))
def test_bricks_add_up_to_the_whole(case, method, dtype, data, cuts):
    """P8: each cut out of the volume and alone on its own grid; samples of a ray depend on its way
    through the grid.
    """
    x = data.draw(volumes(case.grid.shape, dtype))
    ends = [sorted({0, round(cut * n), n}) for cut, n in zip(cuts, case.grid.shape, strict=True)]
    axes = [list(zip(each[:-1], each[1:], strict=True)) for each in ends]
    boxes = [Box((a, c, e), (b, d, f)) for a, b in axes[0] for c, d in axes[1] for e, f in axes[2]]
    if method == "trilinear":
        whole = [torch.zeros_like(x) for _ in boxes]
        for part, box in zip(whole, boxes, strict=True):
            part[..., *box.slices] = x[..., *box.slices]
        A = case.build(method=method)
        parts = [A(part) for part in whole]
    else:
        alone = [replace(case, grid=case.grid.cropped(box)).build(method=method) for box in boxes]
        parts = [A(x[..., *box.slices]) for A, box in zip(alone, boxes, strict=True)]
    apart, steady = allowed(case, x, dtype)
    assert ((case.build(method=method)(x) - sum(parts)).abs().double() <= apart)[..., steady].all()


@given(**ANY, seed=SEEDS, share=st.floats(0, 1))
def test_skipping_empty_voxels_changes_no_bit(case, method, dtype, data, seed, share):
    """P10: by value and by a support, for any values outside it."""
    x = data.draw(volumes(case.grid.shape, dtype))
    support = masks(seed, case.grid.shape, share)
    dense, within = case.build(method=method, skip="off"), torch.where(support, x, 0)
    assert skip_gap(dense, x) == skip_gap(dense, within) == 0
    views = dense(within)
    for skip in ("off", "box", "brick", "auto"):
        held = case.build(method=method, skip=skip, support=support)
        assert torch.equal(held(torch.where(support, x, torch.nan)), views)
        volume = held.T(views)
        assert not volume[..., ~support].any()
        apart = (volume - torch.where(support, dense.T(views), 0)).abs()
        assert (apart <= 100 * epsilon(dtype) * dense.T(views.abs()).abs()).all()


@given(**ANY, seed=SEEDS, rays=st.sampled_from([1, 1, 2]))
def test_subsets_of_views_are_bitwise_those_of_all_views(case, method, dtype, data, seed, rays):
    x = data.draw(volumes(case.grid.shape, dtype))
    A, m = case.build(method=method, rays_per_pixel=rays), len(case.rays)
    B = view_subset(
        A,
        torch.randperm(m, generator=torch.Generator().manual_seed(seed))[: seed % (m + 1)].tolist(),
    )
    assert torch.equal(B(x), B.selection(A(x)))


@given(**ANY, seed=SEEDS, rays=st.sampled_from([1, 1, 2]))
def test_subsets_of_rays_match_those_of_all_rays(case, method, dtype, data, seed, rays):
    """Rows and single pixels, to what `Subset` promises."""
    x = data.draw(volumes(case.grid.shape, dtype))
    A, (m, v, u) = (
        case.build(method=method, rays_per_pixel=rays),
        (len(case.rays), *case.rays.shape),
    )
    rows = (torch.arange(v) % 2 == seed % 2)[None, :, None].expand(m, v, u)
    for B in (ray_subset(A, rows), ray_subset(A, masks(seed, (m, v, u), 0.4))):
        apart, size = (each.double().norm() for each in (B(x) - B.selection(A(x)), A(x.abs())))
        assert apart <= {torch.float32: 1e-6, torch.float64: 1e-12}[dtype] * size


def test_an_empty_subset_of_several_rays_per_pixel_is_supported():
    """Shrunk: a mean over the rays of no pixel at all was refused by torch."""
    case = CASES["cone"]
    A = case.build(rays_per_pixel=2)
    for B in (ray_subset(A, torch.zeros(5, 8, 5, dtype=torch.bool)), view_subset(A, [])):
        values = B(torch.ones(1, 2, *case.grid.shape))
        assert (
            values.shape == (1, 2, *B.range_shape) and not values.numel() and not B.T(values).any()
        )
