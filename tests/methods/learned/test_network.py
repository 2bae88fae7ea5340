"""Methods take a network by name, a plugin's too; they see to sizes and to the start at zero."""

import pytest
import torch
from torch import nn

from mvrecon.core.parts import NETWORKS
from mvrecon.methods.learned.baselines import network_by_name
from mvrecon.testing import check_method, check_network
from tests.methods.learned.rig import SMALL, blob, small, small_projector

TINY, UNET = {"name": "tiny"}, {"name": "unet", "widths": [4, 6]}
WITH_NETWORK = ("world_unet", "geometry_free")


class Tiny(nn.Module):
    """A plugin's network, for sizes that 4 divides."""

    multiple = 4

    def __init__(self, inputs, outputs, channels=3):
        super().__init__()
        self.first, self.last = nn.Conv3d(inputs, channels, 4, 4), nn.Conv3d(channels, outputs, 1)

    def forward(self, x):
        assert not any(size % self.multiple for size in x.shape[2:])
        coarse = self.last(nn.functional.silu(self.first(x)))
        return nn.functional.interpolate(coarse, scale_factor=4.0, mode="nearest")


class Smaller(nn.Conv3d):
    """A network whose answer is smaller than its input."""

    def __init__(self, inputs, outputs):
        super().__init__(inputs, outputs, 5)


@pytest.fixture(autouse=True)
def registered(monkeypatch):
    """The networks by name, for one test."""
    monkeypatch.setitem(NETWORKS._parts, "tiny", Tiny)
    monkeypatch.setitem(NETWORKS._parts, "smaller", Smaller)


@pytest.mark.parametrize("config", [TINY, UNET], ids=lambda config: config["name"])
def test_networks_keep_the_contract(config):
    check_network(**config)


@pytest.mark.parametrize("name", WITH_NETWORK)
def test_a_method_with_a_network_by_name_keeps_the_contract(name):
    check_method(name, small_projector(), **SMALL[name] | {"network": TINY})


def test_before_training_any_network_keeps_the_initial_volume():
    """The change of it is zero, so the volume is the same with any network."""
    A = small_projector()
    views = A(blob(A))
    volumes = [small("world_unet", network=network)(views, A).volume for network in (None, TINY)]
    assert torch.equal(*volumes) and volumes[0].any()


@pytest.mark.parametrize("sizes", [(1, 1, 1), (6, 5, 7)])
def test_volumes_of_any_size_are_padded_and_cropped(sizes):
    torch.manual_seed(0)
    network, x = network_by_name(TINY, 2, 3, zero=1), torch.randn(2, 2, *sizes)
    answer = network(x)
    assert answer.shape == (2, 3, *sizes)
    assert not answer[:, 0].any() and answer[:, 1:].any()


@pytest.mark.parametrize(
    ("network", "error", "message"),
    [
        ({"name": "unit"}, LookupError, "did you mean 'unet'"),
        ({"widths": [3]}, TypeError, "A network needs a 'name'"),
        ({"name": "unet", "width": [3]}, TypeError, "did you mean 'widths'"),
    ],
)
@pytest.mark.parametrize("name", WITH_NETWORK)
def test_an_incompatible_network_is_refused(name, network, error, message):
    """A network that is unknown, without a name, or misspelt in an option."""
    with pytest.raises(error, match=message):
        small(name, network=network)


def test_an_output_of_the_wrong_size_is_refused():
    """With both sizes."""
    network = network_by_name({"name": "smaller"}, 1, 1)
    with pytest.raises(ValueError, match=r"\(1, 1, 8, 8, 8\).* got \(1, 1, 4, 4, 4\)"):
        network(torch.zeros(1, 1, 8, 8, 8))
