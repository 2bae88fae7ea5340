"""The loss of the opinions: what it is for the start, and what it teaches."""

import pytest
import torch

from mvrecon.losses import ReconstructionLoss
from mvrecon.models.cross_view.model import CrossView
from mvrecon.models.output import Reconstruction
from tests.models.cross_view.test_model import blob
from tests.models.cross_view.test_opinions import CHOICES
from tests.models.rig import small_projector


def test_a_loss_relative_to_the_start_is_two_for_the_start_and_knows_no_unit():
    """One for each camera's opinion, and one for the weighted one; zero where they are right."""
    torch.manual_seed(0)
    truth = torch.rand(2, 1, 6, 6, 6)
    start = truth + 0.1 * torch.rand(2, 1, 6, 6, 6)
    coarse = torch.nn.functional.avg_pool3d
    opinions = coarse(start, 2)[:, None].expand(-1, 3, -1, -1, -1, -1)
    visible = torch.ones(3, 1, 3, 3, 3, dtype=torch.bool)
    weights = torch.full((2, 3, 1, 3, 3, 3), 1 / 3)

    def gain(opinions, factor=1.0):
        out = Reconstruction(
            factor * start, factor * opinions, visible, weights, start=factor * start
        )
        loss = ReconstructionLoss(1.0, opinions_gain=1.0)
        return float(loss(out, {"volume": factor * truth, "views": truth})["opinions_gain"])

    assert gain(opinions) == pytest.approx(2.0, rel=1e-3)
    assert gain(opinions, 1e-2) == pytest.approx(2.0, rel=1e-3)
    right = coarse(truth, 2)[:, None].expand_as(opinions)
    assert gain(right) == pytest.approx(0.0, abs=1e-6)
    assert gain((opinions + right) / 2) == pytest.approx(0.5, rel=1e-3)


def test_with_a_loss_of_their_own_opinions_leave_the_start_and_differ():
    """Views of one camera are 20 % too bright, and nobody corrects them: opinions come nearer to
    the truth than the start, whose loss is 2, and they are no longer one picture."""
    projector = small_projector()
    truth = blob(projector)
    views = projector(truth)
    views[:, :, 1] *= 1.2
    torch.manual_seed(0)
    model = CrossView(projector, CHOICES["weighted"], start=6)
    loss = ReconstructionLoss(1.0, volume=0.0, opinions_gain=1.0)
    optimizer = torch.optim.AdamW(model.parameters(), lr=1e-2)
    batch, errors = {"volume": truth, "views": views}, []
    for _ in range(25):
        out = model(views)
        terms = loss(out, batch)
        errors.append(float(terms["opinions_gain"].detach()))
        optimizer.zero_grad()
        terms["total"].backward()
        optimizer.step()
    assert errors[-1] < 0.8 * errors[0] and errors[-1] < 1.5
    opinions = out.opinions.detach()
    spread = (opinions - opinions.mean(dim=1, keepdim=True)).square().mean()
    start = torch.nn.functional.avg_pool3d(out.start, 2)[:, None]
    assert spread > 0.05 * (opinions - start).square().mean()
