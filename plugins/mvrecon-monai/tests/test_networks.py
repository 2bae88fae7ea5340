"""MONAI's networks keep the contract of networks; where MONAI is not installed they name it."""

import sys
import tomllib
from importlib import import_module
from pathlib import Path

import pytest
import torch
import yaml

from mvrecon.core.parts import NETWORKS
from mvrecon.geometry.cameras.rigs import circular
from mvrecon.geometry.grid import Grid
from mvrecon.methods.learned.baselines import network_by_name
from mvrecon.methods.method import build_method
from mvrecon.operators.drr import Drr
from mvrecon.testing import check_network

ROOT = Path(__file__).parents[1]
PARTS = {
    key.partition(".")[2]: getattr(import_module(where.partition(":")[0]), where.partition(":")[2])
    for key, where in tomllib.loads((ROOT / "pyproject.toml").read_text())["project"][
        "entry-points"
    ]["mvrecon.plugins"].items()
    if key.startswith("network.")
}
SMALL = {
    "monai_basic_unet": {"width": 4},
    "monai_dynunet": {"width": 4, "levels": 3, "residual": True},
    "monai_segresnet": {"width": 4},
    "monai_swin_unetr": {"width": 12},
}


@pytest.fixture(autouse=True)
def registered(monkeypatch: pytest.MonkeyPatch):
    """The parts by name, whether the plugin is installed or only on Python's path."""
    for name, part in PARTS.items():
        monkeypatch.setitem(NETWORKS._parts, name, part)


@pytest.fixture
def monai():
    pytest.importorskip("monai", reason="needs monai==1.6.1 (pip install monai)")
    pytest.importorskip("einops", reason="needs einops==0.8.2 (pip install einops)")


@pytest.mark.parametrize("name", SMALL)
def test_the_contract_of_networks(name: str, monai: None):
    check_network(name, **SMALL[name])


@pytest.mark.parametrize("name", SMALL)
def test_the_smallest_size_can_be_trained(name: str, monai: None):
    """Of one voxel on the coarsest level, where a channel's own normalisation has no variance."""
    network = network_by_name({"name": name, **SMALL[name]}, 1, 1)
    network(torch.randn(1, 1, 3, 2, 5)).sum().backward()
    assert all(p.grad is not None and p.grad.isfinite().all() for p in network.parameters())


def test_options_reach_monai(monai: None):
    """Channels of the levels, as the weights of the built networks have them."""

    def widths(name: str, **options: int) -> set[int]:
        weights = PARTS[name](2, 3, **options).parameters()
        return {weight.shape[0] for weight in weights if weight.dim() == 5}

    assert {6, 12, 24, 48} <= widths("monai_basic_unet", width=6)
    assert max(widths("monai_dynunet", width=8, levels=7)) == 320
    assert {6, 12, 24, 48} <= widths("monai_segresnet", width=6)
    assert {24, 48, 384} <= widths("monai_swin_unetr")


@pytest.mark.parametrize("name", PARTS)
def test_a_missing_library_is_reported_with_the_install_command(
    name: str, monkeypatch: pytest.MonkeyPatch
):
    """A MONAI network without MONAI or einops raises an error with the install command."""
    for module in [m for m in sys.modules if m.partition(".")[0] in ("monai", "einops")]:
        monkeypatch.delitem(sys.modules, module)
    for module in ("monai", "einops"):
        monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(ImportError, match="pip install (monai|einops)"):
        PARTS[name](1, 1)


@pytest.mark.parametrize(
    ("name", "options"),
    [
        ("monai_basic_unet", {"width": -1}),
        ("monai_dynunet", {"levels": 2}),
        ("monai_segresnet", {"width": 0}),
        ("monai_swin_unetr", {"width": 16}),
    ],
)
def test_unknown_network_options_are_refused(name: str, options: dict[str, int]):
    """Too few channels or levels of a network of MONAI, or channels that 12 does not divide."""
    with pytest.raises(ValueError, match="[Ee]xpected|must be"):
        PARTS[name](1, 1, **options)


def test_every_network_has_a_config_of_its_name():
    folder = ROOT / "mvrecon_monai" / "conf" / "network"
    chosen = {file.stem: yaml.safe_load(file.read_text()) for file in folder.glob("*.yaml")}
    assert chosen == {name: {"name": name} for name in PARTS} and set(PARTS) == set(SMALL)


@pytest.mark.parametrize("name", SMALL)
def test_a_method_reconstructs_with_it(name: str, monai: None):
    """A U-Net in the volume by another network is SIRT before training, and of any size."""
    config = {"name": "world_unet", "start": 4, "consistency": 0}
    rig = circular(3, 60.0, 120.0, {"pixels": [8, 8], "pixel_mm": 6.0})
    A = Drr(Grid.centred(size=(7, 8, 9), spacing=2.0), rig)
    views = A(torch.rand(1, 1, *A.domain_shape))
    own = build_method(config)(views, A).volume
    other = build_method({**config, "network": {"name": name, **SMALL[name]}})(views, A).volume
    torch.testing.assert_close(other, own)
