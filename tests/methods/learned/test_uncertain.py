"""The standard deviation of a method's error, around any method."""

from dataclasses import replace

import pytest
import torch

from mvrecon.training.losses import ReconstructionLoss
from tests.methods.learned.rig import SMALL, blob, small, small_projector, stirred

LOSS = ReconstructionLoss(1.0, uncertainty=1e-3)
INNER = {"name": "cross_view", **SMALL["cross_view"]}


@pytest.fixture(scope="module")
def case():
    """An operator, a volume and its views, which are a little wrong."""
    A = small_projector()
    truth = blob(A)
    views = A(truth)
    return A, {"volume": truth, "views": views * (1 + 0.02 * torch.randn_like(views))}


def test_volume_and_training_equal_those_of_the_method_alone(case):
    """Bit for bit, forward and backward: no gradient of sigma reaches the method."""
    A, batch = case
    plain, other = small("cross_view"), small("uncertain", method=INNER)
    other.method.load_state_dict(plain.state_dict())
    outs = [method(batch["views"], A) for method in (plain, other)]
    assert outs[0].sigma is None and torch.equal(outs[0].volume, outs[1].volume)
    terms = [LOSS(out, batch) for out in outs]
    assert "uncertainty" in terms[1] and "uncertainty" not in terms[0]
    for term in terms:
        term["total"].backward()
    gradients = dict(other.method.named_parameters())
    for name, parameter in plain.named_parameters():
        one, two = parameter.grad, gradients[name].grad
        assert (one is None and two is None) or torch.equal(one, two)
    assert other.network.last.weight.grad.any()


@pytest.mark.parametrize("method", [{"name": "sirt", "iterations": 3}, {"name": "fdk"}], ids=str)
@torch.no_grad()
def test_a_classical_method_has_a_standard_deviation_too(method, case):
    A, batch = case
    out = stirred("uncertain", method=method)(batch["views"], A)
    assert torch.equal(out.volume, small(**method)(batch["views"], A).volume)
    assert (out.sigma > 0).all() and out.sigma.std() > 0


@pytest.mark.filterwarnings("ignore:Rays are up to")
@torch.no_grad()
def test_sigma_scales_with_the_views_and_is_zero_outside_the_hull(case):
    A, _ = case
    views = A(blob(A))
    method = stirred("uncertain", method={**INNER, "support": "hull"})
    out, tripled = method(views, A), method(3 * views, A)
    assert not out.sigma[~out.support].any() and (out.sigma[out.support] > 0).all()
    assert out.sigma[out.support].std() > 0
    torch.testing.assert_close(tripled.sigma, 3 * out.sigma, rtol=1e-4, atol=1e-5)
    terms = LOSS(out, {"volume": blob(A), "views": views})
    assert terms["uncertainty"].isfinite()


def test_sixty_steps_learn_where_the_volume_is_wrong(case):
    """Sigma is larger where the error is, and its mean square is the error's within a factor 2."""
    A, batch = case
    truth = batch["volume"] + 0.3  # an error of zero has no finite logarithm
    batch = {"volume": truth, "views": batch["views"] + A(torch.full_like(truth, 0.3))}
    inner = {"name": "sirt", "iterations": 12, "momentum": True}
    method = small("uncertain", method=inner)
    optimizer = torch.optim.AdamW(method.parameters(), lr=2e-3)
    for _ in range(60):
        out = method(batch["views"], A)
        optimizer.zero_grad()
        LOSS(out, batch)["uncertainty"].backward()
        optimizer.step()
    error, sigma = (out.volume - truth).square(), out.sigma.detach()
    large = error > error.median()
    assert sigma[large].mean() > 1.5 * sigma[~large].mean()
    assert 0.5 < float(sigma.square().mean() / error.mean()) < 2


def test_an_error_of_zero_has_a_finite_likelihood(case):
    A, batch = case
    out = small("uncertain", method={"name": "sirt", "iterations": 3})(batch["views"], A)
    out = replace(out, sigma=0 * out.sigma)
    assert LOSS(out, batch | {"volume": out.volume})["uncertainty"].isfinite()
