"""Methods take a network by name, a plugin's too, for volumes of any size, with a start at zero."""

import pytest
import torch
from torch import nn

from mvrecon.models.method import build_method
from mvrecon.models.network import network_by_name
from mvrecon.parts import NETWORKS
from mvrecon.testing import check_method, check_network
from tests.models.rig import small_projector

OPTIONS = {"unet": {"widths": [4, 6]}, "tiny": {}}


class Tiny(nn.Module):
    """A plugin's network, of sizes that 4 divides."""

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


@pytest.mark.parametrize("name", OPTIONS)
def test_networks_keep_the_contract(name):
    check_network(name, **OPTIONS[name])


@pytest.mark.parametrize(
    ("name", "options"),
    [
        ("world_unet", {"network": {"name": "tiny"}}),
        ("geometry_free", {"network": {"name": "tiny", "channels": 2}, "n_cameras": 4}),
    ],
)
def test_a_method_with_a_network_by_name_keeps_the_contract(name, options):
    check_method(name, small_projector(), **options)


def test_before_training_any_network_leaves_the_start():
    A = small_projector()
    views = A(torch.rand(1, 1, *A.grid.shape))
    networks = (None, *({"name": name, **options} for name, options in OPTIONS.items()))
    first, *others = (
        build_method({"name": "world_unet", "network": network})(views, A).volume
        for network in networks
    )
    assert first.any() and all(torch.equal(first, other) for other in others)


@pytest.mark.parametrize(
    ("network", "error", "message"),
    [
        ({"name": "unit"}, LookupError, "did you mean 'unet'"),
        ({"widths": [3]}, TypeError, "A network needs a 'name'"),
        ({"name": "unet", "widht": [3]}, TypeError, "did you mean 'widths'"),
    ],
)
def test_a_network_that_there_is_not_is_refused(network, error, message):
    """Unknown, without a name, or with a misspelt option."""
    with pytest.raises(error, match=message):
        build_method({"name": "world_unet", "network": network})


def test_an_answer_of_another_size_is_refused(monkeypatch):
    """With both sizes."""
    monkeypatch.setitem(NETWORKS._parts, "valid", lambda i, o: nn.Conv3d(i, o, 3))
    network = network_by_name({"name": "valid"}, 1, 1)
    with pytest.raises(ValueError, match=r"\(1, 1, 8, 8, 8\).* got \(1, 1, 6, 6, 6\)"):
        network(torch.zeros(1, 1, 8, 8, 8))
