"""Conservation: lifted densities integrate to the views, and weights over cameras sum to one."""

import pytest
import torch
from hypothesis import given, strategies as st

from mvrecon.core.parts import HEADS
from mvrecon.geometry.lattice import enclosed
from mvrecon.kernels.warps import normalised_places
from mvrecon.methods.learned.view_frames import Frusta, fuse, leave_one_out, pooled
from tests.operators.cases import Case
from tests.properties.strategies import SEEDS, cases, real, volumes

EPS = torch.finfo(torch.float32).eps
SIZES = st.sampled_from([0.0, 1.0, 30.0, 1e3, 1e5])
SHAPES = st.tuples(st.integers(1, 4), *[st.integers(1, 5)] * 3)


def frusta_of(case: Case, depth: int) -> Frusta:
    return Frusta.of(case.grid, case.rays, depth)


FRUSTA = st.builds(frusta_of, cases(), st.integers(1, 12))


@given(case=cases(), depth=st.integers(1, 12))
def test_a_box_holds_the_samples_whose_places_lie_in_it(case, depth):
    """Voxels in every frustum, and its bins in the grid; within 1e-12 of a face rounding
    decides.
    """
    frusta = frusta_of(case, depth)
    ways = (
        (frusta.frusta_from_world, frusta.shape, case.grid.shape),
        (frusta.world_from_frusta, case.grid.shape, frusta.shape),
    )
    for maps, source, shape in ways:
        reach = normalised_places(maps, source, shape).abs().amax(dim=-1) - 1 - 1e-9
        within = enclosed(maps, source, shape).mask
        assert within[reach < -1e-12].all() and not within[reach > 1e-12].any()


def measured(frusta: Frusta, data: st.DataObject) -> torch.Tensor:
    """Views [1 c m v u] with zeros, small and great numbers among them."""
    sizes = (len(frusta.slant), *frusta.shape[1:])
    return data.draw(volumes(sizes, torch.float32, signed=False)).clamp_max(1e20)


@given(frusta=FRUSTA, data=st.data())
def test_the_lift_keeps_every_ray_s_integral(frusta, data):
    views = measured(frusta, data)
    sees = (frusta.chord > 0)[:, 0, 0]
    lifted = frusta.spread(views)
    assert not (lifted * ~frusta.occupied).any()
    assert (
        (frusta.integrate(lifted) - views * sees).abs() <= 4 * frusta.shape[0] * EPS * views
    ).all()


@given(
    frusta=FRUSTA, data=st.data(), size=SIZES, shift=st.sampled_from([0.0, 1e5, -1e5]), seed=SEEDS
)
@pytest.mark.parametrize("name", [name for name in HEADS.names() if HEADS.build(name).keeps_views])
def test_view_preserving_heads_preserve_views_for_any_logits(name, frusta, data, size, shift, seed):
    views = measured(frusta, data)[:, :1]
    rng = torch.Generator().manual_seed(seed)
    shape = (1, len(frusta.slant), 1, *frusta.shape)
    logits = size * torch.randn(shape, generator=rng) + shift
    prior = data.draw(volumes(shape[1:], torch.float32))[:, :1].reshape(shape)
    density = HEADS.build(name)(logits, prior, views, frusta)
    assert (
        density.isfinite().all() and (density >= 0).all() and not (density * ~frusta.occupied).any()
    )
    sees = (frusta.chord > 0)[:, 0, 0]
    assert (
        (frusta.integrate(density) - views * sees).abs()
        <= 8 * frusta.shape[0] * EPS * views + 1e-37
    ).all()


def seen(shape, seed: int, share: float) -> torch.Tensor:
    """Which voxels each of m cameras sees [m 1 d h w]."""
    m, *sizes = shape
    return torch.rand(m, 1, *sizes, generator=torch.Generator().manual_seed(seed)) < share


@given(
    shape=SHAPES, size=SIZES, shift=st.sampled_from([0.0, 1e5, -1e5]), share=real(0, 1), seed=SEEDS
)
def test_fusion_is_a_mean(shape, size, shift, share, seed):
    """Weights sum to one over the cameras that see a voxel; equal estimates are kept; no mean
    leaves the range of the estimates.
    """
    visible, rng = seen(shape, seed, share), torch.Generator().manual_seed(seed + 1)
    m, *sizes = shape
    logits = size * torch.randn(2, m, 1, *sizes, generator=rng) + shift
    estimates = torch.randn(2, m, 1, *sizes, generator=rng)
    fused, weights = fuse(estimates, logits, visible)
    some = visible.any(dim=0)
    assert (weights >= 0).all() and not (weights * ~visible).any() and not (fused * ~some).any()
    assert ((weights.sum(dim=1) - some.float()).abs() <= 4 * m * EPS).all()
    low = torch.where(visible, estimates, torch.inf).amin(dim=1)
    high = torch.where(visible, estimates, -torch.inf).amax(dim=1)
    slack = 8 * m * EPS * estimates.abs().amax(dim=1)
    assert (((fused >= low - slack) & (fused <= high + slack)) | ~some).all()
    equal = estimates[:, :1].expand_as(estimates)
    assert (
        (fuse(equal, logits, visible)[0] - equal[:, 0] * some).abs()
        <= 8 * m * EPS * equal[:, 0].abs()
    ).all()
    order = torch.randperm(m, generator=rng)
    assert torch.allclose(
        fuse(estimates[:, order], logits[:, order], visible[order])[0], fused, rtol=0, atol=1e-5
    )


@given(shape=SHAPES, share=real(0, 1), seed=SEEDS, away=st.sampled_from([0.0, 1.0, 1e3]))
def test_what_the_others_say(shape, share, seed, away):
    """Leaving one out is forming the mean and the variance of those that are left."""
    visible, rng = seen(shape, seed, share), torch.Generator().manual_seed(seed + 1)
    m, *sizes = shape
    volumes = torch.randn(1, m, 2, *sizes, generator=rng, dtype=torch.float64) + away
    mean, variance, count = leave_one_out(volumes, visible)
    for k in range(m):
        others = [j for j in range(m) if j != k]
        if not others:
            assert not mean.any() and not variance.any() and not count.any()
            continue
        expected, spread = pooled(volumes[:, others], visible[others])
        assert torch.allclose(mean[:, k], expected[:, 0], rtol=1e-12, atol=1e-12)
        assert torch.allclose(variance[:, k], spread[:, 0], rtol=1e-9, atol=1e-9)
        assert torch.equal(count[k], visible[others].double().sum(dim=0))
