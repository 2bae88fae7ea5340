"""Weighting networks: their contract, the shipped weights, and the inputs that the model passes."""

import pytest
import torch
from torch import nn

from mvrecon.core.files.runs import shipped_weights
from mvrecon.core.parts import WEIGHTINGS
from mvrecon.methods.learned.cross_view import CrossView
from mvrecon.methods.learned.unet import PlainUNet
from mvrecon.methods.learned.view_frames import coarsened, deviation, fuse, leave_one_out
from mvrecon.methods.learned.weightings import CHANNELS
from mvrecon.testing import check_method, check_weighting
from mvrecon.training.weights_file import read
from tests.methods.learned.rig import SMALL, blob, small, small_projector, stirred


@pytest.mark.parametrize("name", WEIGHTINGS.names())
def test_contract(name):
    check_weighting(name)


@pytest.mark.parametrize("widths", [[3], [4, 6], [2, 3, 4]], ids=str)
def test_a_unet_of_any_widths_keeps_the_contract(widths):
    check_weighting("unet", widths=widths)


@torch.no_grad()
def test_the_shipped_weights_load_and_give_the_logits_of_a_plain_unet():
    """As when the weighting network was part of the model: `weight_net.*`, six channels, one scale
    of 8 channels, no bias at the end.
    """
    state = read(shipped_weights()["any_rig"])[2]
    own = {
        name.removeprefix("method.weight_net."): value
        for name, value in state.items()
        if name.startswith("method.weight_net.")
    }
    plain = PlainUNet(3, 6, 1, (8,))
    plain.last.bias = None
    plain.load_state_dict(own)
    method = CrossView(weight_widths=[8], ray_widths=[], precision="float32")
    method.load_state_dict({name.removeprefix("method."): value for name, value in state.items()})
    inputs = torch.randn(2, 3, 6, 5, 4, 7)
    logits = method.weight_net(inputs, torch.ones(3, 1, 5, 4, 7, dtype=torch.bool))
    assert logits.any()
    torch.testing.assert_close(logits, plain(inputs.flatten(0, 1)).unflatten(0, (2, 3)))


@pytest.mark.parametrize(
    ("given", "scales", "precision"),
    [
        ({}, [16, 32], "auto"),
        ({"weight_widths": [2, 3]}, [2, 3], "auto"),
        ({"weighting": {"name": "unet", "widths": [5]}, "weight_widths": [2, 3]}, [5], "auto"),
        ({"precision": "float32"}, [16, 32], "float32"),
        ({"weighting": {"name": "unet", "precision": "float32"}}, [16, 32], "float32"),
    ],
    ids=str,
)
def test_options_of_the_network_go_before_those_of_the_model(given, scales, precision):
    network = CrossView(**given).weight_net
    assert [block.first.out_channels for block in network.down] == scales
    assert network.precision == precision


class Recording(nn.Module):
    """Equal weights; keeps its inputs. It has neither of the options that the model shares."""

    def __init__(self, inputs):
        super().__init__()
        self.channels = inputs

    def forward(self, inputs, visible):
        self.given = inputs, visible
        return inputs.new_zeros(inputs[:, :, :1].shape)


@pytest.mark.parametrize(
    "depth", [{}, {"depth": "prior"}, {"depth": "uniform", "depth_widths": []}], ids=str
)
@torch.no_grad()
def test_inputs_are_the_documented_channels(depth, monkeypatch):
    monkeypatch.setitem(WEIGHTINGS._parts, "recording", Recording)
    A = small_projector()
    method = stirred("cross_view", weighting="recording", **depth, precision="float32")
    views = A(blob(A))
    out, network = method(views, A), method.weight_net
    inputs, visible = network.given
    assert torch.equal(visible, out.visible)
    names = CHANNELS[:-1] if "depth_widths" in depth else CHANNELS
    assert network.channels == inputs.shape[2] == len(names)
    channels = dict(zip(names, inputs.split(1, 2), strict=True))
    # views and volumes are divided by the content's scale
    scale = out.start.square().sum() / out.start.abs().sum()
    start = coarsened(out.start, 1)[:, None].expand_as(out.per_view) / scale
    change = out.per_view / scale - start
    torch.testing.assert_close(channels["volume"], start, rtol=1e-4, atol=1e-5)
    torch.testing.assert_close(channels["change"], 8 * change, rtol=1e-3, atol=1e-4)
    mean, variance, _ = leave_one_out(change, visible)
    torch.testing.assert_close(channels["others"], 8 * mean, rtol=1e-3, atol=1e-4)
    torch.testing.assert_close(channels["deviation"], 8 * deviation(variance), rtol=1e-2, atol=1e-3)
    if "confidence" in names:
        weights = fuse(change, channels["confidence"], visible)[1]
        torch.testing.assert_close(out.weights, weights, rtol=1e-4, atol=1e-5)


class Summed(Recording):
    """Logits that would be broadcast over the cells."""

    def forward(self, inputs, visible):
        return inputs.mean(dim=(2, 3, 4, 5), keepdim=True)


def test_logits_of_wrong_shape_are_refused_by_the_model(monkeypatch):
    monkeypatch.setitem(WEIGHTINGS._parts, "summed", Summed)
    A = small_projector()
    message = r"Expected logits \[1, 4, 1, 6, 6, 6\] from Summed\(\), got \[1, 4, 1, 1, 1, 1\]"
    with pytest.raises(ValueError, match=message):
        small("cross_view", weighting="summed")(A(blob(A)), A)


class Rule(nn.Module):
    """Logits that fall with the unexplained part relative to its mean over the cameras."""

    def __init__(self, inputs):
        super().__init__()
        self.strength = nn.Parameter(torch.zeros(()))

    def forward(self, inputs, visible):
        unexplained = inputs[:, :, 3:4].square() * visible
        mean = unexplained.mean(dim=1, keepdim=True) + 1e-3
        return -self.strength.exp() * unexplained / mean


@pytest.mark.parametrize(
    "options", [{}, {"depth": "prior", "depth_widths": []}, {"weigh_rays": False}], ids=str
)
def test_a_rule_of_one_parameter_keeps_both_contracts(options, monkeypatch):
    monkeypatch.setitem(WEIGHTINGS._parts, "rule", Rule)
    check_weighting("rule")
    options = SMALL["cross_view"] | {"weighting": "rule"} | options
    check_method("cross_view", small_projector(), **options)
