"""Contract checks of methods, and of networks, heads and weighting networks of learned methods."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn

from mvrecon.core.parts import HEADS, WEIGHTINGS
from mvrecon.methods.learned.baselines import network_by_name
from mvrecon.methods.learned.view_frames import Frusta
from mvrecon.methods.learned.weightings import CHANNELS
from mvrecon.methods.method import build_method
from mvrecon.operators.operator import PerSample, Projector
from mvrecon.testing.measures import batch_gap, gap, homogeneity_gap

#: Relative tolerance, in float64.
FLOAT64_TOLERANCE = 1e-8
#: The same for a network's float32 sums of some thousand products a voxel.
FLOAT32_TOLERANCE = 1e-5


def check_method(name: str, A: Projector, seed: int = 0, **options: Any) -> None:
    """Raise AssertionError unless the named method satisfies its contract with this operator.

    A finite volume of the grid's shape and of the views' dtype (float32 and float64; also of a
    network's weights), bitwise repeatable; zero views give a zero volume; a sample's volume depends
    neither on the other samples of its batch nor on their order, and is the same with a batch of
    operators; views of another shape, or with a non-finite value, raise a ValueError that names
    them.

    For a network, with random weights, so that zero-initialised layers take part: scaling the views
    scales the volume; gradients of the volume, or of its standard deviation, reach every parameter.
    A method without parameters explains the views better than an empty volume. Views that require a
    gradient are refused with a ValueError or have one, which is finite also for empty views and for
    rows with rounding at their ends.

    Args:
        name: name of the method.
        A: the operator; at least two cameras.
        seed: seed of weights and volumes.
        options: options of the method.

    Raises:
        TypeError, ValueError: what the method returns is no `Reconstruction` on the grid; see
            `build_method`.
    """
    torch.manual_seed(seed)
    method = build_method({"name": name, **options}).eval()
    learned = any(parameter.numel() for parameter in method.parameters())
    with torch.no_grad():
        for parameter in method.parameters():
            parameter += 0.1 * torch.randn_like(parameter)
        views = A(torch.rand(2, 1, *A.grid.shape))
        for dtype in (torch.float32, torch.float64):
            _check_volume(method.to(dtype), views.to(dtype), A)
        views = views.double()  # from here on; in float32 convolutions may round to bfloat16
        volume = method(views, A).volume
        nothing = method(torch.zeros_like(views), A).volume.norm()
        allowed = 0.0 if learned else FLOAT64_TOLERANCE * volume.norm()
        assert nothing <= allowed, "views of zero do not give a volume of zero"
        _check_batch(method, views, A)
        check_refusals(lambda views: method(views, A), views)
        if learned:
            scaled = homogeneity_gap(lambda views: method(views, A).volume, views)
            assert scaled <= FLOAT64_TOLERANCE, f"f(c y) is not c f(y): they differ by {scaled:.2g}"
        else:
            misfit = ((A(volume) - views).norm() / views.norm()).item()
            assert misfit < 1, f"the volume explains the views no better than zero does: {misfit:g}"
    out = method(views, A)
    check_gradients(method, out.volume if out.sigma is None else out.volume + out.sigma)
    _check_input_gradients(method.float(), views.float(), A)


def _check_input_gradients(
    method: nn.Module, views: Float[Tensor, "2 1 m v u"], A: Projector
) -> None:
    rounding = 1e-12 * torch.rand(views.shape[-2:])
    rounding[0] = 1  # the object reaches the detector's edge there
    rounding[1::2, 2:-2] = 1
    for values in (views + views.mean(), views.amax() * rounding, torch.zeros_like(views)):
        values = values.expand_as(views).clone().requires_grad_()
        try:
            volume = method(values, A).volume
        except ValueError:  # "Expected tensors without gradient"
            return
        slope = None
        if volume.requires_grad:
            (slope,) = torch.autograd.grad(volume.square().sum(), values, allow_unused=True)
        assert slope is not None, "views that require a gradient neither have one nor are refused"
        assert slope.isfinite().all(), "gradients in the views are not finite"


def _check_volume(method: nn.Module, views: Float[Tensor, "2 1 m v u"], A: Projector) -> None:
    out = method(views, A)
    assert out.volume.dtype == views.dtype, (
        f"the volume of {views.dtype} views is {out.volume.dtype}"
    )
    assert out.volume.isfinite().all(), "the volume is not finite"
    assert torch.equal(method(views, A).volume, out.volume), "not the same bits when called twice"


def _check_batch(method: nn.Module, views: Float[Tensor, "2 1 m v u"], A: Projector) -> None:
    volume = method(views, A).volume
    assert batch_gap(lambda views: method(views, A).volume, views) <= FLOAT64_TOLERANCE, (
        "a volume depends on the others of its batch"
    )
    assert gap(method(views, PerSample([A, A])).volume, volume) <= FLOAT64_TOLERANCE, (
        "a batch of operators changes the volumes"
    )


def check_gradients(network: nn.Module, answer: Tensor) -> None:
    """Raise AssertionError unless gradients reach every parameter, and are finite."""
    parameters = {
        name: p for name, p in network.named_parameters() if p.requires_grad and p.numel()
    }
    if not parameters:
        return
    values = torch.autograd.grad(
        answer.square().sum(), list(parameters.values()), allow_unused=True
    )
    gradients = dict(zip(parameters, values, strict=True))
    idle = [name for name, value in gradients.items() if value is None or not value.any()]
    assert not idle, f"no gradient reaches {', '.join(idle)}"
    bad = [name for name, value in gradients.items() if not value.isfinite().all()]
    assert not bad, f"gradients are not finite: {', '.join(bad)}"


def check_refusals(method: Callable[[Tensor], Any], views: Float[Tensor, "2 1 m v u"]) -> None:
    """Raise AssertionError unless a method raises a ValueError that names views for invalid views.

    Args:
        method: called with the views.
        views: valid ones.
    """
    spoiled = {"NaN": views.clone(), "inf": views.clone()}
    for value, copy in spoiled.items():
        copy[0, 0, 1, 0, 0] = float(value)
    shapes = {
        "no batch": views[0],
        "no channel": views[:, 0],
        "a camera less": views[:, :, 1:],
        "a camera more": torch.cat([views, views[:, :, :1]], dim=2),
        "a row less": views[..., 1:, :],
        "a column less": views[..., 1:],
    }
    for kind, bad in {**spoiled, **shapes}.items():
        try:
            method(bad)
        except ValueError as error:
            assert "views" in str(error).lower(), (
                f"views with {kind}: the error does not name views: {error}"
            )
        except Exception as error:
            raise AssertionError(
                f"views with {kind}: expected a ValueError, got {error!r}"
            ) from error
        else:
            raise AssertionError(f"views with {kind} are not refused")


def check_network(name: str, seed: int = 0, **options: Any) -> None:
    """Raise AssertionError unless the named network is suitable for a method.

    A finite output of the input's size, including odd sizes unless the network has a `multiple`; an
    initial output of zero on request; in evaluation bitwise repeatable, and independent of other
    samples; gradients reach every parameter.

    Args:
        name: name of the network.
        seed: seed of weights and input.
        options: options of the network.
    """
    torch.manual_seed(seed)
    network = network_by_name({"name": name, **options}, 2, 3, zero=1).eval()
    x = torch.randn(2, 2, 9, 4, 6)
    with torch.no_grad():
        answer = network(x)
        assert not answer[:, :1].any(), "an output that starts at zero is not zero"
        assert answer[:, 1:].any(), "outputs that need not start at zero are all zero"
        for parameter in network.parameters():
            parameter += 0.05 * torch.randn_like(parameter)
        answer = network(x)
        assert answer.isfinite().all(), "the answer is not finite"
        assert torch.equal(network(x), answer), "not the same bits when called twice"
        assert batch_gap(network, x) <= FLOAT32_TOLERANCE, (
            "an answer depends on the others of its batch"
        )
    check_gradients(network, network(x))


def check_head(name: str, frusta: Frusta, seed: int = 0, **options: Any) -> None:
    """Raise AssertionError unless the named head satisfies its contract in these frusta.

    A module with `keeps_views`; a density of the right shape; finite, with a finite gradient in
    logits and prior, also for rays that miss and a prior of zero; zero outside the region; and, for
    a head with `keeps_views = True`, the measured views for any logits and prior, zero on zero
    rays.

    Args:
        name: name of the head.
        frusta: frusta with at least two rows; the rays of the last row are made to miss the region,
            with views of noise.
        seed: seed of logits, prior and views.
        options: options of the head.
    """
    torch.manual_seed(seed)
    head = HEADS.build(name, **options)
    assert isinstance(head, nn.Module), (
        f"a head must be a torch.nn.Module, got {type(head).__name__}"
    )
    keeps_views = getattr(head, "keeps_views", None)
    assert isinstance(keeps_views, bool), (
        f"a head must define keeps_views, True if its density integrates to the views and False "
        f"otherwise; got {keeps_views!r} from {type(head).__name__}"
    )
    frusta = _last_row_missing(frusta)
    depth, v, u = frusta.shape
    m = len(frusta.slant)
    views, hits = torch.rand(2, 1, m, v, u), frusta.chord.reshape(1, 1, m, v, u) > 0
    views[..., : u // 3] = 0
    logits = (3 * torch.randn(2, m, 1, depth, v, u)).requires_grad_()
    prior = torch.rand(logits.shape)
    prior[..., u // 2 :] = 0
    prior.requires_grad_()
    density = head(logits, prior, views, frusta)
    assert isinstance(density, Tensor), (
        f"a head must return a density as a tensor, got {type(density).__name__}"
    )
    assert density.shape == logits.shape, (
        f"density is {tuple(density.shape)}, logits are {tuple(logits.shape)}"
    )
    assert density.isfinite().all(), "density is not finite"
    loss = density.square().sum() + 0 * logits.sum() + 0 * prior.sum()  # some heads ignore them
    gradients = torch.autograd.grad(loss, (logits, prior))
    assert all(one.isfinite().all() for one in gradients), "gradient is not finite"
    density = density.detach()
    assert not (density * ~frusta.occupied).any(), "density outside the region of interest"
    if keeps_views:
        error = (frusta.integrate(density) - views * hits).abs().max() / views.max()
        assert error < 1e-5, f"own views are missed by {error:.2g} of their maximum"


def _last_row_missing(frusta: Frusta) -> Frusta:
    """Frusta without bins in the region on the last row of every detector."""
    end = frusta.bins.end.clone()
    end[..., -1] = 0  # [m 1 D v]
    return replace(frusta, bins=replace(frusta.bins, end=end))


def check_weighting(name: str, seed: int = 0, **options: Any) -> None:
    """Raise AssertionError unless the named weighting network satisfies its contract.

    With and without the channel of the confidence, for one camera and for several, and for grids of
    any size: a module that returns one logit for each camera and cell, in the dtype of its inputs;
    bitwise repeatable in evaluation; independent of the other samples; in another order of the
    cameras the same logits in that order; finite, with finite gradients, also for inputs of zero
    and cells that no camera sees. Gradients reach every parameter.

    Args:
        name: name of the weighting network.
        seed: seed of weights and inputs.
        options: options of the weighting network.
    """
    torch.manual_seed(seed)
    for channels in (len(CHANNELS), len(CHANNELS) - 1):
        network = WEIGHTINGS.build(name, channels, **options)
        assert isinstance(network, nn.Module), (
            f"a weighting network must be a torch.nn.Module, got {type(network).__name__}"
        )
        network = network.eval().double()
        with torch.no_grad():
            for parameter in network.parameters():
                parameter += 0.1 * torch.randn_like(parameter)
        for m, size in ((1, (1, 3, 2)), (4, (5, 4, 7))):
            inputs = torch.randn(2, m, channels, *size, dtype=torch.float64)
            visible = torch.rand(m, 1, *size) < 0.7
            visible[..., 0] = False
            _check_logits(network, inputs, visible)
        check_gradients(network, network(inputs, visible))


def _check_logits(network: nn.Module, inputs: Tensor, visible: Tensor) -> None:
    expected = (*inputs.shape[:2], 1, *inputs.shape[3:])
    logits = network(inputs, visible)
    assert isinstance(logits, Tensor), (
        f"a weighting network must return logits as a tensor, got {type(logits).__name__}"
    )
    assert logits.shape == expected, f"logits are {tuple(logits.shape)}, expected {expected}"
    assert logits.dtype == inputs.dtype, f"logits of {inputs.dtype} inputs are {logits.dtype}"
    assert logits.isfinite().all(), "logits are not finite"
    assert torch.equal(network(inputs, visible), logits), "not the same bits when called twice"
    assert batch_gap(lambda inputs: network(inputs, visible), inputs) <= FLOAT64_TOLERANCE, (
        "logits depend on the other samples of the batch"
    )
    order = torch.arange(inputs.shape[1]).roll(1)
    turned = network(inputs[:, order], visible[order])
    assert gap(turned, logits[:, order]) <= FLOAT64_TOLERANCE, (
        "logits do not follow their cameras' order"
    )
    for values in (inputs, torch.zeros_like(inputs)):
        values = values.clone().requires_grad_()
        logits = network(values, visible)
        assert logits.isfinite().all(), "logits of zero inputs are not finite"
        loss = logits.square().sum() + 0 * values.sum()  # a network may ignore its inputs
        assert torch.autograd.grad(loss, values)[0].isfinite().all(), "gradient is not finite"
