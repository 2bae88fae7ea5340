"""Consistency steps weighted for counts: stable, exact where they must be, and of no scale."""

from dataclasses import replace

import pytest
import torch

from mvrecon.geometry.grid import Box
from mvrecon.methods.classical.mlem import mlem
from mvrecon.methods.classical.poisson import negative_log_likelihood
from mvrecon.methods.classical.sirt import MIN_SENSITIVITY_SHARE, sirt_weights
from mvrecon.methods.learned.geometry import Geometry
from mvrecon.methods.learned.start import (
    Consistency,
    em_change,
    weighted_for_counts,
)
from mvrecon.methods.method import Reconstruction
from mvrecon.operators.operator import Scaled
from mvrecon.testing import check_method
from mvrecon.testing.measures import gradient_gap
from mvrecon.training.losses import ReconstructionLoss
from tests.methods.learned.rig import SMALL, small, small_projector

COUNTED = {"steps": 3, "noise": "poisson"}
EM = {**COUNTED, "rule": "em"}


@pytest.fixture(scope="module")
def geometry():
    return Geometry.of(small_projector())


def volume(geometry, batch: int = 1) -> torch.Tensor:
    random = torch.Generator().manual_seed(0)
    return 0.2 + torch.rand(batch, 1, *geometry.A.grid.shape, generator=random)


def test_weights_equal_those_of_sirt_for_a_uniform_volume(geometry):
    """The counts that it makes are its value times each chord, so R is that of SIRT but for a
    factor.
    """
    flat = torch.full((1, 1, *geometry.A.grid.shape), 2.5)
    counted, views = weighted_for_counts(geometry, geometry.A(flat)), geometry.A(volume(geometry))
    plain = replace(geometry, row=sirt_weights(geometry.A).row)  # also of short chords
    one, other = (g.direction(views - g.A(flat)) for g in (counted, plain))
    # rays that meet next to nothing count as if they expected more
    assert (one - other).norm() < 0.02 * other.norm()


def test_weights_of_counts_take_part_in_the_gradient(geometry):
    """In the volume, the views and the lengths, also of a case that expects nothing."""
    steps, x = Consistency(COUNTED).double(), volume(geometry, 2).double()
    views = geometry.A(volume(geometry, 2).double().flip(2)).requires_grad_()
    x[1] = 0
    like = Geometry.of(geometry.A, torch.float64)

    def corrected(x, views, lengths):
        state = {"lengths": lengths}
        return torch.func.functional_call(steps, state, (like, x, views))[:1]

    lengths = torch.tensor([0.9, 0.8, 0.7]).double().requires_grad_()
    assert gradient_gap(corrected, x.requires_grad_(), views, lengths) < 1e-7
    whole = steps(like, x, views).square().sum()
    assert all(one.isfinite().all() for one in torch.autograd.grad(whole, (x, views)))


def test_each_step_lowers_the_weighted_residual_and_keeps_the_truth(geometry):
    truth, start = volume(geometry), torch.ones(1, 1, *geometry.A.grid.shape)
    views = geometry.A(truth)
    weights = weighted_for_counts(geometry, geometry.A(start)).row
    misfits = []
    for steps in range(5):
        x = Consistency({"steps": steps, "noise": "poisson"}).eval()(geometry, start, views)
        misfits.append((weights * (views - geometry.A(x)).square()).sum().item())
    assert all(b < a for a, b in zip(misfits, misfits[1:], strict=False))
    kept = Consistency(COUNTED)(geometry, truth, views)
    torch.testing.assert_close(kept, truth, rtol=1e-4, atol=1e-4)


def test_steps_bring_the_volume_towards_the_views(geometry):
    truth = volume(geometry)
    views = geometry.A(truth)
    after = Consistency(5)(geometry, 0.5 * truth, views)
    before, after = ((geometry.A(x) - views).norm() for x in (0.5 * truth, after))
    assert after < 0.5 * before


def test_a_sample_that_expects_no_counts_stays_finite(geometry):
    """Where a network makes all of a volume negative."""
    x, views = torch.ones(2, 1, *geometry.A.grid.shape), geometry.A(volume(geometry, 2))
    x[1] *= -1
    both = Consistency(COUNTED)(geometry, x, views)
    assert torch.equal(both[1], x[1])
    torch.testing.assert_close(both[:1], Consistency(COUNTED)(geometry, x[:1], views[:1]))


def test_the_step_is_scale_equivariant_and_a_batch_equals_its_cases(geometry):
    steps = Consistency(COUNTED).eval()
    x, truth = torch.ones(2, 1, *geometry.A.grid.shape), volume(geometry, 2)
    x[1] *= 100
    views = geometry.A(truth)
    views[1] *= 100
    whole = steps(geometry, x, views)
    torch.testing.assert_close(steps(geometry, 1e-3 * x, 1e-3 * views), 1e-3 * whole)
    torch.testing.assert_close(steps(geometry, x[1:], views[1:]), whole[1:])


def test_bright_pixels_have_smaller_weights_than_with_equal_noise(geometry):
    """A wrong pixel changes the volume the less, the more counts it is expected to have."""
    x = volume(geometry)
    x[..., :4, :, :] *= 20
    expected = geometry.A(x)
    pixel = torch.zeros_like(expected)
    bright = int(expected.argmax())
    pixel.view(-1)[bright] = 1.0
    counted = weighted_for_counts(geometry, expected)
    plain, weighted = (g.direction(pixel).abs().sum() for g in (geometry, counted))
    assert weighted < plain


@pytest.mark.parametrize(("name", "rule"), [("world_unet", COUNTED), ("mean_fusion", EM)])
def test_a_method_of_counts_starts_from_osem_and_keeps_the_contract(name, rule):
    start = {"name": "osem", "iterations": 2, "subsets": 2}
    check_method(name, small_projector(), **SMALL[name] | {"start": start, "consistency": rule})


@pytest.fixture(scope="module")
def counted():
    """An operator with pixel weights, as that of SPECT, and Poisson counts of a volume with voids,
    in float64.
    """
    A = small_projector(pixels=8)
    weights = 0.5 + torch.rand(A.range_shape, generator=torch.Generator().manual_seed(3))
    A = Scaled(A, pixels=weights.double())
    geometry = Geometry.of(A, torch.float64)
    truth = volume(geometry).double()
    truth[..., :3] = 0
    counts = torch.poisson(A(truth), generator=torch.Generator().manual_seed(1))
    return geometry, truth, counts


def test_a_step_of_length_one_is_mlem_and_conserves_counts(counted):
    """The change of em is that of one iteration of `mlem`; sensitivity times activity is the
    number of counts.
    """
    geometry, truth, counts = counted
    A, start = geometry.A, torch.ones_like(truth)
    x = start + em_change(geometry, start, counts, A(start))
    torch.testing.assert_close(x, mlem(A, counts, 1, start=start), rtol=1e-5, atol=1e-6)
    assert A(x).sum().item() == pytest.approx(counts.sum().item(), rel=1e-5)
    torch.testing.assert_close(x, Consistency({**EM, "steps": 1}).double()(geometry, start, counts))


def test_with_a_background_descent_raises_a_volume_that_is_negative_everywhere(counted):
    """EM keeps zeros; the gradient must not be zero with them, or a network could not recover."""
    geometry, truth, counts = counted
    steps = Consistency({**EM, "background": 0.01}).double()
    x = torch.full_like(truth, -0.1).requires_grad_()
    (steps(geometry, x, counts) - truth).square().sum().backward()
    active = (truth > 0) & (geometry.A.T(counts) > 0)
    assert (x.grad[active] < 0).all() and active.any()
    assert (x.grad[truth == 0] == 0).all()


def test_steps_are_stable_for_very_unequal_ray_weights(counted):
    """The misfit, weighted by R w, of consistent views never grows, whatever the learned lengths:
    weights of a network on another grid may be large.
    """
    geometry, truth, _ = counted
    y, steps = geometry.A(truth), Consistency(1).double()
    steps.lengths.data.fill_(1.9)
    weights = torch.rand(y.shape, generator=torch.Generator().manual_seed(5)).double()
    weights[:, :, 1] *= 8
    x, misfits = torch.zeros_like(truth), []
    for _ in range(30):
        x = steps(geometry, x, y, weights).detach()
        misfits.append((geometry.row * weights * (y - geometry.A(x)).square()).sum().item())
    assert all(b <= a * (1 + 1e-9) for a, b in zip(misfits, misfits[1:], strict=False))
    assert misfits[-1] < 0.1 * misfits[0]
    # smaller weights, shorter steps: no bound is reached
    some = 0.5 * weights.clamp_max(1)
    direction = geometry.direction(y, some)
    torch.testing.assert_close(steps(geometry, 0 * truth, y, some), 1.9 * direction)


def test_weighted_em_ignores_views_of_zero_weight(counted):
    """Equal weights change nothing; without a background, views of weight zero are left out."""
    geometry, truth, counts = counted
    A, steps, start = geometry.A, Consistency(EM).double(), torch.ones_like(truth)
    equal = steps(geometry, start, counts, torch.full_like(counts, 3.0))
    torch.testing.assert_close(equal, steps(geometry, start, counts))
    weights = torch.ones_like(counts)
    weights[:, :, 1:3] = 0
    x = steps(geometry, start, counts, weights)
    others = [m for m in range(counts.shape[2]) if m not in (1, 2)]
    B = A.cropped(Box.whole(A.grid.shape), others)
    y = counts[:, :, others].contiguous()
    kept = A.T(weights) > MIN_SENSITIVITY_SHARE * A.T(torch.ones_like(counts))
    expected = steps(Geometry.of(B, torch.float64), start, y)
    # a voxel that only those two see keeps its value, which the others never measure
    torch.testing.assert_close(x[kept], expected[kept], rtol=1e-5, atol=1e-6)
    assert torch.equal(x[~kept], start[~kept])


def test_weighted_em_steps_never_lower_the_weighted_likelihood(counted):
    geometry, truth, counts = counted
    weights = torch.rand(counts.shape, generator=torch.Generator().manual_seed(5)).double()
    steps, x = Consistency({**EM, "steps": 1}).double(), 0.1 + volume(geometry).double().flip(2)

    def misfit(x: torch.Tensor) -> float:
        expected = geometry.A(x)
        return (weights * (expected - torch.xlogy(counts, expected))).sum().item()

    values = [misfit(x)]
    for _ in range(4):
        x = steps(geometry, x, counts, weights).detach()
        values.append(misfit(x))
    assert all(b < a for a, b in zip(values, values[1:], strict=False))


@pytest.mark.parametrize("background", [0.0, 0.1])
def test_em_steps_up_to_length_one_never_lower_the_likelihood(counted, background):
    geometry, truth, counts = counted
    r = background * counts[(geometry.row > 0).expand_as(counts)].mean()
    steps = Consistency({**EM, "steps": 1, "background": background}).double()
    for length in (0.3, 0.7, 1.0):
        torch.nn.init.constant_(steps.lengths, length)
        x = 0.1 + volume(geometry).double().flip(2)  # no multiple of the truth
        values = [negative_log_likelihood(counts, geometry.A(x) + r).item()]
        for _ in range(4):
            x = steps(geometry, x, counts).detach()
            values.append(negative_log_likelihood(counts, geometry.A(x) + r).item())
        assert all(b < a for a, b in zip(values, values[1:], strict=False))


def test_exact_data_are_a_fixed_point_of_em_and_gradients_reach_volume_and_lengths(counted):
    geometry, truth, _ = counted
    steps, x = Consistency(EM).double(), truth.clone().requires_grad_()
    after = steps(geometry, x, geometry.A(truth))
    torch.testing.assert_close(after, truth, rtol=1e-5, atol=1e-9)
    other = (truth + 0.5).requires_grad_()
    steps(geometry, other, geometry.A(truth)).square().sum().backward()
    assert all(g.isfinite().all() and g.any() for g in (other.grad, steps.lengths.grad))


@torch.no_grad()
def test_em_hides_scale_and_negative_values_so_the_loss_uses_its_input(counted):
    """Five times too much, and as little as none below zero, end at the same volume."""
    geometry, truth, counts = counted
    step, x = Consistency({**EM, "steps": 1}).double(), truth + 0.5
    x[..., :4] = 0
    wrong = torch.where(x > 0, 5 * x, -10)
    torch.testing.assert_close(step(geometry, wrong, counts), step(geometry, x, counts))
    A = small_projector()
    views = A(volume(Geometry.of(A)))
    methods = [small("cross_view", consistency=steps) for steps in (EM, COUNTED)]
    entry, none = (method(views, A).entry for method in methods)
    assert entry is not None and none is None
    out = Reconstruction(0 * entry, entry=entry - 10)
    error = ReconstructionLoss(1.0, entry=0.01)(out, {"volume": 0 * entry, "views": views})
    assert float(error["total"]) == pytest.approx(0.01 * (entry - 10).square().mean().item())


def test_learned_step_lengths_above_one_empty_no_ray(counted):
    """Ten times too much is cut down to the counts; a step of length 1.2 would end below zero."""
    geometry, truth, counts = counted
    steps = Consistency({**EM, "steps": 1}).double()
    torch.nn.init.constant_(steps.lengths, 1.2)
    x = steps(geometry, 10 * (truth + 0.5), counts)
    total = counts.sum().item()
    assert (x >= 0).all() and geometry.A(x).sum().item() == pytest.approx(total, rel=1e-5)


@pytest.mark.parametrize(
    ("length", "sign", "moves"), [(1.2, 1, False), (1.2, -1, True), (0.7, 1, True)]
)
def test_a_step_length_above_one_only_learns_to_decrease(counted, length, sign, moves):
    """A longer step removes more: fewer counts require a longer step, more counts a shorter one."""
    geometry, truth, counts = counted
    steps = Consistency({**EM, "steps": 1}).double()
    torch.nn.init.constant_(steps.lengths, length)
    (sign * steps(geometry, 10 * (truth + 0.5), counts).sum()).backward()
    assert bool(steps.lengths.grad.any()) == moves


@pytest.mark.parametrize(
    ("steps", "message"),
    [
        ({"steps": 2, "noise": "laplace"}, "gaussian or poisson"),
        ({"stops": 2}, "did you mean 'steps'"),
        (-1, "0 consistency steps or more"),
        ({"rule": "em"}, "em with the noise poisson"),
        ({**COUNTED, "background": 0.1}, "with rule em alone"),
    ],
)
def test_unknown_consistency_options_are_refused(steps, message):
    """A method refuses consistency steps of another noise or rule, of an unknown option, or fewer
    than none.
    """
    with pytest.raises((TypeError, ValueError), match=message):
        small("world_unet", consistency=steps)
