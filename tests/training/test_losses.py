"""Terms of the training loss against values computed by hand, and the effect of the per-view
terms.
"""

import math

import pytest
import torch
from torch.nn.functional import avg_pool3d

from mvrecon.methods.method import Reconstruction
from mvrecon.training.losses import ReconstructionLoss
from tests.methods.learned.rig import blob, small, small_projector, stirred


def test_a_term_without_a_weight_is_left_out():
    truth, views = torch.zeros(1, 1, 4, 4, 4), torch.zeros(1, 1, 2, 4, 4)
    out = Reconstruction(
        truth + 1, per_view=truth[:, None] + 2, predictions=views, binned_views=views
    )
    batch = {"volume": truth, "views": views}
    assert set(ReconstructionLoss(2.0)(out, batch)) == {"volume", "total"}
    terms = ReconstructionLoss(2.0, volume=3.0, cross_view=1.0)(out, batch)
    assert float(terms["volume"]) == pytest.approx(0.25) and float(terms["cross_view"]) == 0
    assert float(terms["total"]) == pytest.approx(0.75)


def test_the_error_of_a_prediction_is_relative_to_its_own_case():
    """Each case's mean square error over its mean square view; a bright case hides no dim one."""
    torch.manual_seed(0)
    views = torch.rand(2, 1, 3, 4, 4) * torch.tensor([1.0, 1e3]).view(2, 1, 1, 1, 1)
    predictions, truth = (
        views * torch.tensor([2.0, 1.1]).view(2, 1, 1, 1, 1),
        torch.zeros(2, 1, 4, 4, 4),
    )
    out = Reconstruction(
        truth,
        per_view=truth[:, None],
        visible=truth[0, None] > 0,
        predictions=predictions,
        binned_views=views,
    )
    terms = ReconstructionLoss(1.0, cross_view=1.0)(out, {"volume": truth, "views": views})
    assert float(terms["cross_view"]) == pytest.approx((1.0 + 0.01) / 2, rel=1e-5)


def test_every_parameter_learns_from_all_terms():
    A, method = small_projector(), stirred("cross_view")
    volume = blob(A, 2)
    views = A(volume)
    weights = {"per_view_gain": 1e-3, "cross_view": 0.01}
    terms = ReconstructionLoss(1.0, **weights)(method(views, A), {"volume": volume, "views": views})
    assert set(terms) == {"volume", *weights, "total"}
    terms["total"].backward()
    assert not [name for name, p in method.named_parameters() if p.grad is None or not p.grad.any()]


def test_the_gain_over_the_initial_volume_is_log_two_for_itself_and_dimensionless():
    """For the cameras' estimates and for the weighted one; zero where they are right, and bounded
    influence where they are far off.
    """
    torch.manual_seed(0)
    truth = torch.rand(2, 1, 6, 6, 6)
    start = truth + 0.1 * torch.rand(2, 1, 6, 6, 6)
    estimates = avg_pool3d(start, 2)[:, None].expand(-1, 3, -1, -1, -1, -1)
    visible = torch.ones(3, 1, 3, 3, 3, dtype=torch.bool)
    weights = torch.full((2, 3, 1, 3, 3, 3), 1 / 3)

    def gain(estimates, factor=1.0):
        out = Reconstruction(
            factor * start, factor * estimates, visible, weights, start=factor * start
        )
        loss = ReconstructionLoss(1.0, per_view_gain=1.0)
        return float(loss(out, {"volume": factor * truth, "views": truth})["per_view_gain"])

    assert gain(estimates) == pytest.approx(2 * math.log(2), rel=1e-3)
    assert gain(estimates, 1e-2) == pytest.approx(2 * math.log(2), rel=1e-3)
    right = avg_pool3d(truth, 2)[:, None].expand_as(estimates)
    assert gain(right) == pytest.approx(0.0, abs=1e-6)
    for times in (0.5, 3.0, 30.0):  # of the error
        expected = 2 * math.log(1 + times**2)
        assert gain(right + times * (estimates - right)) == pytest.approx(expected, rel=1e-3)


def test_with_their_own_loss_per_view_estimates_differ_from_the_initial_volume():
    """One camera's view is 20 % too bright: estimates come nearer to the truth than the start,
    whose loss is 2 log 2, and they are no longer one picture.
    """
    A, method = small_projector(), small("cross_view", start=6)
    truth = blob(A)
    views = A(truth)
    views[:, :, 1] *= 1.2
    loss = ReconstructionLoss(1.0, volume=0.0, per_view_gain=1.0)
    optimizer = torch.optim.AdamW(method.parameters(), lr=1e-2)
    batch, errors = {"volume": truth, "views": views}, []
    for _ in range(25):
        out = method(views, A)
        terms = loss(out, batch)
        errors.append(float(terms["per_view_gain"].detach()))
        optimizer.zero_grad()
        terms["total"].backward()
        optimizer.step()
    assert errors[-1] < 0.8 * errors[0] and errors[-1] < 2 * math.log(1.75)
    estimates = out.per_view.detach()
    spread = (estimates - estimates.mean(dim=1, keepdim=True)).square().mean()
    start = avg_pool3d(out.start, 2)[:, None]
    assert spread > 0.05 * (estimates - start).square().mean()


def test_the_likelihood_is_greatest_at_the_true_variance():
    """Its gradient is zero where sigma^2 is the mean squared error, and points there."""
    torch.manual_seed(0)
    error = 0.3 * torch.randn(1, 1, 8, 8, 8)
    best = error.square().mean().sqrt()
    loss, slopes = ReconstructionLoss(1.0, uncertainty=1e-3), []
    for factor in (0.8, 1.0, 1.25):
        sigma = (factor * best).clone().requires_grad_()
        out = Reconstruction(error, sigma=sigma.expand_as(error))
        loss(out, {"volume": 0 * error, "views": error})["uncertainty"].backward()
        slopes.append(float(sigma.grad))
    assert slopes[0] < -0.1 and abs(slopes[1]) < 1e-4 and slopes[2] > 0.1


@pytest.mark.parametrize(
    "given", [0.0, -1.0, float("nan"), float("inf"), 1e-300, 1e300, 10**400, None, "1", True, [1.0]]
)
def test_a_data_range_is_a_positive_number_whose_square_float32_holds(given):
    """Zero, negative, not a number, infinite, tiny, huge, beyond float64; of another type."""
    with pytest.raises((ValueError, TypeError), match=r"^data_range: expected .*, got "):
        ReconstructionLoss(given)


def test_a_loss_without_any_term_is_refused():
    """No weight, and weights of terms that the reconstruction lacks; one that it has suffices."""
    truth = torch.zeros(1, 1, 4, 4, 4)
    batch = {"volume": truth, "views": truth}
    for weights in ({}, {"entry": 1.0, "uncertainty": 1.0}, {"per_view_gain": 1.0}):
        loss = ReconstructionLoss(1.0, volume=0.0, **weights)
        with pytest.raises(ValueError, match="give loss.volume a weight"):
            loss(Reconstruction(truth + 1), batch)
    terms = ReconstructionLoss(1.0, volume=0.0, entry=2.0)(
        Reconstruction(truth + 1, entry=truth + 3), batch
    )
    assert {name: float(value) for name, value in terms.items()} == {"entry": 9.0, "total": 18.0}


def test_an_unknown_term_is_refused_with_the_nearest():
    with pytest.raises(TypeError, match="did you mean 'per_view_gain'"):
        ReconstructionLoss(1.0, per_view_gains=1.0)
