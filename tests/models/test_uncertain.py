"""Standard deviations of errors: their likelihood, their gradients, and that the volume is trained
as without them.
"""

from dataclasses import replace

import pytest
import torch

from mvrecon.losses import ReconstructionLoss
from mvrecon.models.cross_view.model import CrossView
from mvrecon.models.output import Reconstruction
from tests.models.cross_view.test_model import SMALL, blob
from tests.models.rig import small_projector

LOSS = ReconstructionLoss(1.0, rounds=1.0, uncertainty=1e-3)


@pytest.fixture(scope="module")
def case():
    """An operator, a volume and its views, which are a little wrong."""
    projector = small_projector()
    truth = blob(projector)
    views = projector(truth)
    return projector, {"volume": truth, "views": views * (1 + 0.02 * torch.randn_like(views))}


def model_of(projector, **options) -> CrossView:
    torch.manual_seed(0)
    return CrossView(projector, SMALL["CM3"], **options)


def test_the_volume_and_its_training_are_those_of_the_model_without(case):
    """Bit for bit, forward and backward: no gradient of sigma reaches another network."""
    projector, batch = case
    plain, other = model_of(projector), model_of(projector, uncertainty=True)
    other.load_state_dict(plain.state_dict(), strict=False)
    outs = [model(batch["views"]) for model in (plain, other)]
    assert outs[0].sigma is None and torch.equal(outs[0].volume, outs[1].volume)
    terms = [LOSS(out, batch) for out in outs]
    assert "uncertainty" in terms[1] and "uncertainty" not in terms[0]
    for term in terms:
        term["total"].backward()
    gradients = dict(other.named_parameters())
    for name, parameter in plain.named_parameters():
        one, two = parameter.grad, gradients[name].grad
        assert (one is None and two is None) or torch.equal(one, two)
    assert other.uncertainty.network.last.weight.grad.any()


def test_the_likelihood_is_greatest_at_the_true_variance():
    """Its gradient is zero where sigma^2 is the mean squared error, and says which way to go."""
    torch.manual_seed(0)
    error = 0.3 * torch.randn(1, 1, 8, 8, 8)
    best = error.square().mean().sqrt()
    slopes = []
    for factor in (0.8, 1.0, 1.25):
        sigma = (factor * best).clone().requires_grad_()
        out = Reconstruction(error, sigma=sigma.expand_as(error))
        LOSS(out, {"volume": 0 * error, "views": error})["uncertainty"].backward()
        slopes.append(float(sigma.grad))
    assert slopes[0] < -0.1 and abs(slopes[1]) < 1e-4 and slopes[2] > 0.1


@pytest.mark.filterwarnings("ignore:Rays are up to")
def test_sigma_scales_with_the_views_and_is_zero_outside_the_hull(case):
    projector, _ = case
    views = projector(blob(projector))
    model = model_of(projector, uncertainty=True, support="hull").eval()
    model.uncertainty.network.last.weight.data += 0.1
    with torch.no_grad():
        out, tripled = model(views), model(3 * views)
    assert not out.sigma[~out.support].any() and (out.sigma[out.support] > 0).all()
    assert out.sigma[out.support].std() > 0
    assert torch.allclose(tripled.sigma, 3 * out.sigma, rtol=1e-4)
    truth = blob(projector)
    terms = LOSS(out, {"volume": truth, "views": views})
    assert terms["uncertainty"].isfinite()


def test_two_hundred_steps_teach_where_the_volume_is_wrong(case):
    """Sigma is larger where the error is, and its mean square is the error's within a factor 2."""
    projector, batch = case
    model, inputs = model_of(projector, uncertainty=True), []
    model.uncertainty.register_forward_pre_hook(lambda _, arguments: inputs.append(arguments))
    with torch.no_grad():
        out = model(batch["views"])
        scale = out.start.amax() / inputs[0][3][0].amax()
    optimizer = torch.optim.AdamW(model.uncertainty.parameters(), lr=2e-3)
    for _ in range(200):
        out = replace(out, sigma=scale * model.uncertainty(*inputs[0]))
        optimizer.zero_grad()
        LOSS(out, batch)["uncertainty"].backward()
        optimizer.step()
    error, sigma = (out.volume - batch["volume"]).square(), out.sigma.detach()
    large = error > error.median()
    assert sigma[large].mean() > 1.5 * sigma[~large].mean()
    assert 0.5 < float(sigma.square().mean() / error.mean()) < 2
