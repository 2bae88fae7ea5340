"""The term of the loss for the voxels that all cameras see."""

import pytest
import torch

from mvrecon.geometry.cameras.field import common_field
from mvrecon.methods.method import Reconstruction
from mvrecon.training.losses import ReconstructionLoss
from mvrecon.training.module import ReconstructionModule

GEOMETRY = {
    "grid": {"size": [10, 10, 10], "spacing": 20.0},
    "camera": {"name": "dcspect80", "pixels": [12, 12], "columns": [2, 12]},
    "projector": {"name": "drr"},
}


@pytest.fixture(scope="module")
def module():
    method = {"name": "sirt", "iterations": 2}
    weights = {"common_field": 3.0}
    return ReconstructionModule(GEOMETRY, method, weights, {"name": "adamw"}, 2.0)


def test_the_term_is_the_mean_square_over_the_common_field(module):
    cameras, grid = module.projector.cameras, module.projector.grid
    field = common_field(cameras, grid)
    assert 0 < field.float().mean() < 0.5
    truth = torch.rand(2, 1, *grid.shape, generator=torch.Generator().manual_seed(0))
    batch = {"volume": truth, "views": module.projector(truth)}
    terms, out = module.terms(batch), module(batch["views"])
    error = ((out.volume - truth) / 2).square()
    torch.testing.assert_close(terms["common_field"], error[:, field].mean())
    torch.testing.assert_close(terms["total"], error.mean() + 3 * error[:, field].mean())


def test_voxels_outside_the_field_and_the_support_have_no_gradient():
    loss = ReconstructionLoss(1.0, volume=0.0, common_field=1.0)
    field, support = torch.zeros(1, 2, 2, 2, dtype=torch.bool), torch.ones(1, 1, 2, 2, 2).bool()
    field[0, 0], support[..., 0] = True, False
    volume = torch.ones(1, 1, 2, 2, 2, requires_grad=True)
    out = Reconstruction(volume, support=support)
    batch = {"volume": torch.zeros_like(volume), "views": volume, "common_field": field}
    loss(out, batch)["total"].backward()
    assert torch.equal(volume.grad != 0, support & field) and volume.grad.sum() == 2


def test_without_a_weight_there_is_no_term():
    plain = ReconstructionModule(
        GEOMETRY, {"name": "sirt", "iterations": 2}, {"volume": 1.0}, {"name": "adamw"}, 2.0
    )
    truth = torch.rand(1, 1, *plain.projector.grid.shape)
    assert "common_field" not in plain.terms({"volume": truth, "views": plain.projector(truth)})
