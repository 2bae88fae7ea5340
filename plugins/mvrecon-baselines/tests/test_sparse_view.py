"""The schools of sparse-view reconstruction: views between measured ones, and the networks around
filtered back-projection.
"""

from dataclasses import replace

import pytest
import torch

from mvrecon.methods.classical.fdk import fbp
from mvrecon.methods.method import build_method
from mvrecon.testing import gap
from mvrecon.training.losses import ReconstructionLoss
from mvrecon_baselines.breast import BRIGHTEST, BreastSlices
from mvrecon_baselines.sparse_view import DualDomain, FbpUNet, SinogramUNet, Upsampling

NET = {"width": 4, "levels": 3}


def same_cameras(one, other) -> bool:
    pairs = [(getattr(one, name), getattr(other, name)) for name in ("source", "origin", "u", "v")]
    return all(torch.allclose(a, b, atol=1e-9) for a, b in pairs)


@torch.no_grad()
def stirred(method: torch.nn.Module) -> torch.nn.Module:
    """With random weights, so that layers that start at zero take part."""
    torch.manual_seed(0)
    for parameter in method.parameters():
        parameter += 0.1 * torch.randn_like(parameter)
    return method


@pytest.fixture
def A(fan):
    return fan()


@pytest.fixture
def case(A):
    """Views and volume of a case."""
    sample = BreastSlices(detail=3).sample(0, 0, A.grid, A.cameras)
    return sample.views[None], sample.volume[None]


def test_a_full_circle_is_upsampled_to_the_dense_rig(fan):
    angles = Upsampling.of(fan(8), 3)
    assert angles.closed and same_cameras(angles.dense.cameras, fan(24).cameras)


def test_an_open_scan_is_not_extended_beyond_its_last_view(stack):
    angles = Upsampling.of(stack(6), 2)
    assert not angles.closed and len(angles.dense.cameras) == 11
    assert same_cameras(angles.dense.cameras, stack(12).cameras[:11])


def test_shuffled_views_are_sorted(A):
    views, shuffle = A(torch.rand(1, 1, *A.grid.shape)), torch.randperm(8)
    plain = Upsampling.of(A, 2)
    shuffled = Upsampling.of(type(A)(A.grid, A.cameras[shuffle]), 2)
    first, rig = plain.dense.cameras, shuffled.dense.cameras
    turn = int((rig.source - first.source[0]).norm(dim=1).argmin())
    assert same_cameras(first, rig[torch.arange(16).roll(-turn)])
    assert torch.equal(plain(views), shuffled(views[:, :, shuffle]).roll(-turn, dims=2))


def test_upsampling_keeps_measured_views_and_interpolates_a_disc(fan):
    sparse, dense = fan(32), fan(64)
    i = torch.arange(16) - 7.5
    disc = (1 - torch.hypot(i[:, None], i) / 5).clamp_min(0)[None, None, None]
    views, expected = Upsampling.of(sparse, 2)(sparse(disc)), dense(disc)
    assert torch.equal(views[:, :, ::2], sparse(disc))
    assert (views - expected).abs().max() < 0.02 * expected.max()


def test_before_training_the_image_domain_method_returns_fbp(A, case):
    expected = fbp(A, case[0])
    volume = FbpUNet(**NET)(case[0], A).volume
    assert (volume - expected).abs().max() < 1e-5 * expected.abs().max()


def test_slices_of_a_stack_are_reconstructed_one_by_one(stack):
    """In the image domain the content of a slice changes no other."""
    A, method = stack(), stirred(FbpUNet(**NET))
    x = torch.rand(1, 1, 3, 16, 16)
    with torch.no_grad():
        start = fbp(A, A(x))
        alone = method.image_net(start[:, :, :1])
        assert torch.allclose(method.image_net(start)[:, :, :1], alone, atol=1e-6)


def test_the_gradient_reaches_the_sinogram_network_through_the_back_projection(A, case):
    """It is that of finite differences."""
    method = stirred(SinogramUNet(factor=2, **NET)).double()
    y, truth = (tensor.double() for tensor in case)

    def loss() -> torch.Tensor:
        return ((method(y, A).volume - truth) / truth.max()).square().mean()

    weight = method.sinogram_net.last.weight
    (gradient,) = torch.autograd.grad(loss(), weight)
    direction, step = torch.randn_like(weight), 1e-5
    with torch.no_grad():
        weight += step * direction
        after = loss()
        weight -= 2 * step * direction
        slope = (after - loss()) / (2 * step)
    assert slope.abs() > 0
    assert torch.allclose((gradient * direction).sum(), slope, rtol=1e-5)


@torch.no_grad()
def test_a_full_circle_sinogram_is_treated_as_periodic(A, case):
    """A convolution corrects rotated views as it corrects the views, rotated."""
    torch.manual_seed(0)
    method, angles = SinogramUNet(factor=2), Upsampling.of(A, 2)
    method.sinogram_net = torch.nn.Conv3d(2, 1, (1, 3, 3), padding=(0, 1, 1))
    rotated = method.completed(angles, case[0].roll(4, dims=2))
    assert gap(rotated, method.completed(angles, case[0]).roll(8, dims=2)) <= 1e-5


def batch(views: torch.Tensor, truth: torch.Tensor) -> dict[str, torch.Tensor]:
    return {"volume": truth, "views": views}


def test_the_completed_views_loss_is_zero_only_for_the_true_views(fan, A, case):
    loss = ReconstructionLoss(BRIGHTEST, completed_views=1.0)
    out, true = SinogramUNet(factor=2)(case[0], A), fan(16)(case[1])
    assert gap(out.dense(case[1]), true) <= 1e-6
    assert loss(out, batch(*case))["completed_views"] > 0
    exact = replace(out, completed=out.dense(case[1]))
    assert float(loss(exact, batch(*case))["completed_views"]) == 0
    level = replace(out, completed=out.dense(case[1]) + 0.1 * BRIGHTEST * 160)
    assert float(loss(level, batch(*case))["completed_views"]) == pytest.approx(0.01, rel=1e-4)
    other = FbpUNet(**NET)(case[0], A)
    assert float(loss(other, batch(*case))["completed_views"].detach()) == 0


def test_the_completed_views_loss_trains_only_the_sinogram_network(A, case):
    method = stirred(DualDomain(factor=2))
    loss = ReconstructionLoss(BRIGHTEST, completed_views=1.0)
    loss(method(case[0], A), batch(*case))["completed_views"].backward()
    assert all(p.grad is not None for p in method.sinogram_net.parameters())
    assert all(p.grad is None for p in method.image_net.parameters())


def test_a_few_steps_on_completed_views_beat_linear_interpolation(A, case):
    torch.manual_seed(0)
    method, errors = SinogramUNet(factor=2, width=4, levels=2), []
    loss = ReconstructionLoss(BRIGHTEST, volume=0.0, completed_views=1.0)
    optimizer = torch.optim.Adam(method.parameters(), lr=3e-3)
    for _ in range(41):
        total = loss(method(case[0], A), batch(*case))["total"]
        errors.append(float(total.detach()))
        optimizer.zero_grad()
        total.backward()
        optimizer.step()
    assert errors[-1] < 0.6 * errors[0]


@pytest.mark.parametrize("name", ["fbp_unet", "sinogram_unet", "dual_domain", "itnet"])
def test_a_rig_without_fbp_is_refused(name, fan):
    """A method of filtered back-projection refuses a rig whose angles do not suffice."""
    A = fan(arc_degrees=90.0)
    with pytest.raises(ValueError, match="of the lines .* are not measured"):
        build_method({"name": name})(torch.ones(1, 1, *A.range_shape), A)


def test_a_weighted_operator_is_refused(A):
    """A method of filtered back-projection refuses an operator of weighted integrals."""
    with pytest.raises(ValueError, match="plain line integrals"):
        SinogramUNet(factor=2)(torch.ones(1, 1, *A.range_shape), 2 * A)


def test_a_factor_below_one_is_refused():
    """A number of views below the measured one is refused."""
    with pytest.raises(ValueError, match="at least 1 for views, got 0"):
        SinogramUNet(factor=0)
