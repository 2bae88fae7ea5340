"""The schools and the unrolled methods on a fan's slice and on a stack of slices."""

from dataclasses import replace
from functools import partial

import pytest
import torch

from mvrecon.engine.module import ReconstructionModule
from mvrecon.losses import ReconstructionLoss
from mvrecon.models.sparse_view.itnet import ItNet, growth
from mvrecon.models.sparse_view.primal_dual import PrimalDual, _norm_bound
from mvrecon.parts import MODELS
from mvrecon.projectors.operator import Projector
from mvrecon.reconstructors.filtered.fdk import fbp
from mvrecon.reconstructors.power import power_norm
from mvrecon.testing import check_model
from mvrecon.testing.projector import close
from tests.models.sparse_view.conftest import fan, rig, stack, stirred

NET = {"network": {"name": "unet2d", "width": 4, "levels": 3}}
SMALL = {
    "fbp_unet": NET,
    "sinogram_unet": {**NET, "factor": 2},
    "dual_domain": {**NET, "sinogram_network": NET["network"], "factor": 2},
    "itnet": {**NET, "iterations": 2},
    "primal_dual": {"iterations": 2, "width": 4},
}


@pytest.mark.parametrize("rig", [fan, stack])
@pytest.mark.parametrize("name", SMALL)
def test_slices_and_stacks_keep_the_contract_of_models(name, rig):
    check_model(name, rig(), **SMALL[name])


@pytest.mark.parametrize("name", ["fbp_unet", "itnet"])
def test_untrained_networks_leave_the_classical_answer(name, A, sample):
    """Networks start at zero: filtered back-projection, and steps from it towards the data."""
    model, y = MODELS.build(name, A, **SMALL[name]), sample.views[None]
    x = fbp(A, y)
    for _ in range(2 if name == "itnet" else 0):
        x = x + fbp(A, y - A(x)) / growth(A)
    volume = model(y).volume
    assert (volume - x).abs().max() < 1e-5 * x.abs().max()


def test_slices_of_a_stack_are_reconstructed_one_by_one():
    """Image domain: what is in one slice changes no other."""
    A = stack()
    model = stirred(MODELS.build("fbp_unet", A, **NET)).eval()
    x = torch.rand(1, 1, 3, 16, 16)
    with torch.no_grad():
        start = fbp(A, A(x))
        alone = model.net(start[:, :, :1])
        assert torch.allclose(model.net(start)[:, :, :1], alone, atol=1e-6)


def test_the_gradient_reaches_the_sinogram_network_through_the_back_projection(A, sample):
    """It is that of finite differences."""
    model = stirred(MODELS.build("sinogram_unet", A, **SMALL["sinogram_unet"])).double()
    y, truth = sample.views[None].double(), sample.volume[None].double()

    def loss() -> torch.Tensor:
        return (model(y).volume / truth.max() - truth / truth.max()).square().mean()

    weight = model.completion.net.last.weight
    (gradient,) = torch.autograd.grad(loss(), weight)
    direction, step = torch.randn_like(weight), 1e-5
    with torch.no_grad():
        weight += step * direction
        after = loss()
        weight -= 2 * step * direction
        slope = (after - loss()) / (2 * step)
    assert slope.abs() > 0
    assert torch.allclose((gradient * direction).sum(), slope, rtol=1e-5)


def test_a_step_towards_the_data_keeps_what_explains_it(A, sample):
    model, x = ItNet(A, **SMALL["itnet"]), sample.volume[None]
    assert torch.equal(model.consistent(x, A(x), torch.tensor(1.0)), x)


def test_steps_of_the_length_one_stay_bounded_where_those_of_filtered_back_projection_do_not(A):
    torch.manual_seed(0)
    model, x = ItNet(A, **SMALL["itnet"]), torch.rand(1, 1, *A.grid.shape)
    y, plain, ours = torch.zeros(1, 1, 8, 1, 32), x, x
    with torch.no_grad():
        for _ in range(30):
            plain = plain - fbp(A, A(plain))
            ours = model.consistent(ours, y, torch.tensor(1.0))
    assert model.growth > 2
    assert ours.norm() < 2 * x.norm() < 1e-3 * plain.norm()


@pytest.mark.parametrize("rig", [fan, stack])
def test_the_bound_of_the_norm_is_above_the_norm_and_near_it(rig):
    A: Projector = rig()
    model = PrimalDual(A)
    assert 1 <= _norm_bound(model.row, model.column) / power_norm(A) < 1.5


def test_a_sinogram_of_a_whole_turn_has_no_first_view(sample, A):
    """A convolution corrects views that were turned on as it corrects the views, turned on."""
    model, views = MODELS.build("sinogram_unet", A, factor=2).completion, sample.views[None]
    torch.manual_seed(0)
    model.net = torch.nn.Conv3d(2, 1, (1, 3, 3), padding=(0, 1, 1))
    with torch.no_grad():
        turned = model(views.roll(4, dims=2))
        assert close(turned, model(views).roll(8, dims=2), 1e-5)


def dense_batch(A, sample) -> dict[str, torch.Tensor]:
    """A case with its true views from twice as many angles."""
    truth = sample.volume[None]
    return {"volume": truth, "views": sample.views[None], "true_views": fan(views=16)(truth)}


def test_the_sinogram_loss_is_zero_for_the_true_sinogram_of_all_angles_and_it_alone(A, sample):
    model, batch = MODELS.build("sinogram_unet", A, factor=2), dense_batch(A, sample)
    loss = ReconstructionLoss(0.026, corrected_views=1.0)
    out = model(batch["views"])
    assert loss(out, batch)["corrected_views"] > 0
    true = replace(out, corrected_views=(batch["true_views"],))
    assert float(loss(true, batch)["corrected_views"]) == 0
    level = replace(out, corrected_views=(batch["true_views"] + 0.1 * 0.026 * 160,))
    assert float(loss(level, batch)["corrected_views"]) == pytest.approx(0.01, rel=1e-4)


def test_the_sinogram_loss_teaches_the_sinogram_network_alone(A, sample):
    model, batch = stirred(MODELS.build("dual_domain", A, factor=2)), dense_batch(A, sample)
    loss = ReconstructionLoss(0.026, corrected_views=1.0)
    loss(model(batch["views"]), batch)["corrected_views"].backward()
    assert all(p.grad is not None for p in model.completion.parameters())
    assert all(p.grad is None for p in model.net.parameters())


def test_a_few_steps_on_the_sinogram_s_error_pass_linear_interpolation(A, sample):
    torch.manual_seed(0)
    network = {**NET["network"], "levels": 2}
    model = MODELS.build("sinogram_unet", A, factor=2, network=network)
    loss, errors = ReconstructionLoss(0.026, volume=0.0, corrected_views=1.0), []
    batch, optimizer = dense_batch(A, sample), torch.optim.Adam(model.parameters(), lr=3e-3)
    for _ in range(41):
        total = loss(model(batch["views"]), batch)["total"]
        errors.append(float(total.detach()))
        optimizer.zero_grad()
        total.backward()
        optimizer.step()
    assert errors[-1] < 0.6 * errors[0]


def test_in_training_the_true_sinogram_is_of_the_rig_that_the_model_completes(A, sample):
    geometry = {
        "grid": {"size": [16, 16, 1], "spacing": 10.0},
        "camera": {"name": "circular", **rig()},
        "projector": {"name": "drr"},
    }
    make = partial(ReconstructionModule, geometry, loss={"corrected_views": 1.0})
    module = make({"name": "sinogram_unet", "factor": 2}, optimizer={}, data_range=0.026)
    truth = sample.volume[None]
    assert close(module._on_rig({}).corrected(truth), fan(views=16)(truth), 1e-6)
    plain = make({"name": "fbp_unet"}, optimizer={}, data_range=0.026)
    assert plain._on_rig({}).corrected is plain.projector


@pytest.mark.parametrize("name", ["fbp_unet", "sinogram_unet", "dual_domain", "itnet"])
def test_a_rig_without_filtered_back_projection_is_refused_when_the_model_is_built(name):
    """A model of filtered back-projection is refused for a rig whose angles do not suffice."""
    with pytest.raises(ValueError, match="180 degrees and the fan"):
        MODELS.build(name, fan(arc_degrees=90.0))


@pytest.mark.parametrize(
    ("name", "options"),
    [
        ("itnet", {"iterations": 0}),
        ("itnet", {"memory": -1}),
        ("primal_dual", {"iterations": 0}),
        ("primal_dual", {"channels": 1}),
    ],
)
def test_iterations_and_channels_that_are_too_few_are_refused(name, options, A):
    """Too few iterations or channels of an unrolled model are refused."""
    with pytest.raises(ValueError, match="at least"):
        MODELS.build(name, A, **options)
