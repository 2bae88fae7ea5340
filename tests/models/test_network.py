"""Every model takes a network by name, a plugin's too; mask, size and the start at zero are the
model's care.
"""

import pytest
import torch
from torch import nn

from mvrecon.models.network import SizedNetwork, network_by_name
from mvrecon.models.networks import UNet3d
from mvrecon.parts import MODELS, NETWORKS
from mvrecon.testing import check_model, check_network
from tests.models.rig import small_projector
from tests.models.test_published import SMALL
from tests.models.test_single_pass import OPTIONS

BUILT_IN = {"unet": {"width": 4, "levels": 2}, **SMALL}


class Tiny(nn.Module):
    """A plugin's network: it knows no mask, and takes sizes that 4 divides."""

    multiple = 4

    def __init__(self, inputs, outputs, channels=3):
        super().__init__()
        self.first, self.last = nn.Conv3d(inputs, channels, 4, 4), nn.Conv3d(channels, outputs, 1)

    def forward(self, x):
        assert not any(size % self.multiple for size in x.shape[2:])
        coarse = self.last(nn.functional.silu(self.first(x)))
        return nn.functional.interpolate(coarse, scale_factor=4.0, mode="nearest")


@pytest.fixture(autouse=True)
def tiny(monkeypatch):
    """The plugin, for one test."""
    monkeypatch.setitem(NETWORKS._parts, "tiny", Tiny)


@pytest.mark.parametrize("name", [*BUILT_IN, "tiny"])
def test_networks_keep_the_contract(name):
    check_network(name, **BUILT_IN.get(name, {}))


MODELS_WITH_NETWORKS = {
    "single_pass": {"network": {"name": "tiny"}, "opinion": {"network": {"name": "tiny"}}},
    "mean_fusion": {
        "opinion": {"network": {"name": "residual_unet3d", **SMALL["residual_unet3d"]}}
    },
    "backprojection_unet": {"network": {"name": "unet3d", **SMALL["unet3d"]}, "support": "hull"},
    "geometry_free": {"network": {"name": "tiny", "channels": 2}},
}


@pytest.mark.parametrize("name", MODELS_WITH_NETWORKS)
def test_a_model_with_a_network_by_name_keeps_the_contract(name):
    check_model(name, small_projector(), **OPTIONS.get(name, {}), **MODELS_WITH_NETWORKS[name])


def test_every_model_that_learns_from_volumes_is_here():
    learned = {
        name
        for name in MODELS.names()
        if any(
            isinstance(module, UNet3d | SizedNetwork)
            for module in MODELS.build(name, small_projector(), **OPTIONS.get(name, {})).modules()
        )
    }
    assert learned == set(MODELS_WITH_NETWORKS)


@pytest.mark.parametrize("name", ["single_pass", "backprojection_unet"])
def test_before_training_any_network_leaves_the_model_s_start(name):
    """What corrects starts at zero, so the answer is the same with any network in the world."""
    projector = small_projector()
    views = projector(torch.rand(1, 1, *projector.grid.shape))
    volumes = []
    for network in (
        None,
        {"name": "tiny"},
        {"name": "residual_unet3d", **SMALL["residual_unet3d"]},
    ):
        torch.manual_seed(0)
        options = {**OPTIONS.get(name, {}), "network": network}
        volumes.append(MODELS.build(name, projector, **options)(views).volume)
    assert torch.equal(volumes[0], volumes[1]) and torch.equal(volumes[0], volumes[2])


def test_outside_the_mask_of_a_support_no_network_adds_anything():
    torch.manual_seed(0)
    network = network_by_name({"name": "tiny"}, 2, 1, width=8)
    x, mask = torch.randn(2, 2, 6, 5, 7), torch.rand(2, 1, 6, 5, 7) > 0.6
    answer = network(x, mask)
    assert torch.equal(answer, network(x) * mask) and answer.any()


def test_mvrecon_s_own_network_by_name_is_the_same_as_without_one():
    """To the last bit, weights and answers."""
    nets = []
    for config in (None, {"name": "unet", "width": 6}):
        torch.manual_seed(0)
        nets.append(network_by_name(config, 2, 3, width=6, zero=1))
    x = torch.randn(1, 2, 6, 5, 7)
    assert nets[0].state_dict().keys() == nets[1].state_dict().keys()
    assert torch.equal(nets[0](x), nets[1](x)) and not nets[0](x)[:, 0].any()


@pytest.mark.parametrize(
    ("model", "options", "error", "message"),
    [
        ("geometry_free", {"network": {"name": "unit"}}, LookupError, "did you mean 'unet'"),
        ("geometry_free", {"network": {"width": 3}}, TypeError, "A network needs a 'name'"),
        (
            "geometry_free",
            {"network": {"name": "unet", "widht": 3}},
            TypeError,
            "did you mean 'width'",
        ),
        ("single_pass", {"refine": 0, "network": {"name": "unet"}}, ValueError, "refine=0"),
        ("mean_fusion", {"network": {"name": "unet"}}, ValueError, "refine=0"),
        (
            "single_pass",
            {"opinion": {"prior": "uniform", "network": {"name": "unet"}}},
            ValueError,
            "prior='uniform' has no network",
        ),
    ],
)
def test_a_network_that_a_model_cannot_use_is_refused(model, options, error, message):
    """A network that is unknown, nameless, misspelt in an option or without a use in the model is
    refused.
    """
    with pytest.raises(error, match=message):
        MODELS.build(model, small_projector(), **OPTIONS.get(model, {}), **options)


def test_a_network_s_answer_of_another_size_is_refused():
    """A network that answers with another size is refused by a model, with both sizes."""
    network = network_by_name(
        {"name": "unet3d", "width": 1, "levels": 1, "norm": "none"}, 1, 1, width=8
    )
    with pytest.raises(ValueError, match=r"\(1, 1, 8, 8, 8\).* got \(1, 1, 4, 4, 4\).*'same'"):
        network(torch.zeros(1, 1, 8, 8, 8))
