import pytest
import torch
from torch import nn

from mvrecon.core.parts import HEADS
from mvrecon.methods.learned.view_frames import Frusta
from mvrecon.testing import check_head
from tests.methods.learned.rig import blob, small, small_projector, small_rig


@pytest.mark.parametrize("name", HEADS.names())
def test_contract(name):
    check_head(name, Frusta.of(*small_rig(), depth=12))


class Summed(nn.Module):
    """A head whose density would be broadcast along the rays."""

    keeps_views = False

    def forward(self, logits, prior, views, frusta):
        return prior.sum(dim=3, keepdim=True)


def test_a_density_of_wrong_shape_is_refused_by_the_model(monkeypatch):
    monkeypatch.setattr(HEADS, "_parts", {"summed": Summed})
    A = small_projector()
    message = r"Expected a density \[1, 4, 1, 8, .*\] from Summed\(\), got \[1, 4, 1, 1,"
    with pytest.raises(ValueError, match=message):
        small("cross_view", head="summed")(A(blob(A)), A)


def test_softmax_depth_of_zero_logits_follows_the_prior():
    frusta = Frusta.of(*small_rig(), depth=12)
    head = HEADS.build("softmax_depth")
    prior = (torch.rand(1, 4, 1, *frusta.shape) + 0.5) * frusta.occupied
    views = frusta.integrate(prior)  # the prior already explains the views, so nothing may change
    assert torch.allclose(head(torch.zeros_like(prior), prior, views, frusta), prior, rtol=0.05)


def test_density_of_zero_logits_is_the_prior():
    frusta = Frusta.of(*small_rig(), depth=12)
    prior = (torch.rand(1, 4, 1, *frusta.shape) + 0.5) * frusta.occupied
    out = HEADS.build("density")(torch.zeros_like(prior), prior, frusta.integrate(prior), frusta)
    assert torch.allclose(out, prior, rtol=1e-4, atol=1e-6)


def test_logits_shift_mass_only_along_the_ray():
    frusta = Frusta.of(*small_rig(), depth=12)
    head = HEADS.build("softmax_depth")
    views = torch.rand(1, 1, 4, 12, 12) + 0.1
    logits = torch.zeros(1, 4, 1, *frusta.shape)
    ray = frusta.occupied[0, 0].all(dim=0).nonzero()[0]  # a ray with every bin inside
    before = head(logits, torch.ones_like(logits), views, frusta)
    logits[0, 0, 0, 5, ray[0], ray[1]] = 3.0
    change = head(logits, torch.ones_like(logits), views, frusta) - before
    assert change[0, 0, 0, 5, ray[0], ray[1]] > 0
    assert torch.allclose(frusta.integrate(change), torch.zeros_like(views), atol=1e-5)
    change[0, 0, 0, :, ray[0], ray[1]] = 0
    assert not change.any()
