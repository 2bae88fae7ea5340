"""Methods and networks keep their contracts, and the experiment trains them."""

from math import isfinite
from pathlib import Path

import pytest
import torch
import yaml

import mvrecon_baselines.conf
from mvrecon.apps.config import compose
from mvrecon.apps.settings import TrainSettings
from mvrecon.apps.train import train
from mvrecon.core.files.runs import read_rows
from mvrecon.core.options import check
from mvrecon.core.parts import NETWORKS
from mvrecon.methods.learned.baselines import network_by_name
from mvrecon.methods.method import build_method
from mvrecon.testing import check_method, check_network
from mvrecon.testing.measures import gradient_gap

CONF = Path(mvrecon_baselines.conf.__file__).parent
NET = {"width": 4, "levels": 3}
METHODS = {
    "dif_net": {"widths": [4, 6], "features": 4},
    "svct": {"widths": [4, 6], "features": 4, "decoder": [4, 6]},
    "fbp_unet": NET,
    "sinogram_unet": {**NET, "factor": 2},
    "dual_domain": {**NET, "factor": 2},
    "itnet": {**NET, "iterations": 2},
    "primal_dual": {"iterations": 2, "width": 4},
    "radon_unet": {"n_cameras": 8, "widths": [4, 6], "angles": 24},
}
SMALL_NETWORKS = {
    "unet2d": NET,
    "unet3d": {"width": 2, "levels": 3, "norm": "group", "padding": "same"},
    "residual_unet3d": {"width": 2, "levels": 3},
}
FLAT = ("fbp_unet", "sinogram_unet", "dual_domain", "itnet", "primal_dual")


@pytest.mark.parametrize("rig", ["fan", "stack"])
@pytest.mark.parametrize("name", FLAT)
def test_slice_methods_keep_the_contract(name, rig, request):
    check_method(name, request.getfixturevalue(rig)(), **METHODS[name])


@pytest.mark.parametrize("name", METHODS)
def test_methods_keep_the_contract_on_cone_beams(name, cone):
    check_method(name, cone(n_views=8), **METHODS[name])


@pytest.mark.parametrize("name", METHODS)
def test_gradients_in_the_views_are_those_of_finite_differences(name, cone):
    """Also of the start, and of the scale by which views are divided."""
    A = cone(n_views=8)
    torch.manual_seed(0)
    method = build_method({"name": name, **METHODS[name]}).double()
    with torch.no_grad():
        for parameter in method.parameters():
            parameter += 0.1 * torch.randn_like(parameter)
    views = A(torch.rand(1, 1, *A.grid.shape).double()).requires_grad_()
    gap = gradient_gap(lambda y: method(y, A).volume, views, directions=1, step=1e-7)
    assert gap < 1e-5


@pytest.mark.parametrize("name", SMALL_NETWORKS)
def test_networks_keep_the_contract(name, cone):
    """By themselves, and in a method."""
    check_network(name, **SMALL_NETWORKS[name])
    network = {"name": name, **SMALL_NETWORKS[name]}
    check_method("world_unet", cone(pixels=24), network=network, support="hull")


def test_a_method_refuses_a_network_without_padding():
    """The expected and actual output sizes."""
    network = network_by_name({"name": "unet3d", "width": 1, "levels": 1, "norm": "none"}, 1, 1)
    with pytest.raises(ValueError, match=r"\(1, 1, 8, 8, 8\).* got \(1, 1, 4, 4, 4\)"):
        network(torch.zeros(1, 1, 8, 8, 8))


@pytest.mark.parametrize("name", METHODS)
def test_weights_transfer_to_another_rig_and_grid(name, fan, cone):
    """Only the operator defines the geometry."""
    method = build_method({"name": name, **METHODS[name]}).eval()
    flat = name in FLAT
    for A in (fan(8), fan(8, size=20), fan(12)) if flat else (cone(8), cone(8, size=10, pixels=9)):
        with torch.no_grad():
            volume = method(A(torch.rand(1, 1, *A.grid.shape)), A).volume
        assert volume.shape[2:] == A.grid.shape and volume.isfinite().all()


def test_every_command_line_choice_is_a_part_with_its_options():
    for file in CONF.glob("method/*.yaml"):
        check(compose(f"method={file.stem}"), TrainSettings)
    for file in CONF.glob("network/*.yaml"):
        network = NETWORKS.from_config(yaml.safe_load(file.read_text()), 1, 1)
        assert isinstance(network, torch.nn.Module)
    check(compose("scene=breast"), TrainSettings)


def test_the_experiment_trains_all_slice_methods(tmp_path):
    """A few steps, with the loss of completed views for methods that complete views."""
    small = ("grid.size=[16,16,1]", "grid.spacing=11.25", "camera.n_views=8", "method.width=4")
    widths = [f"compare.{name}.width=4" for name in ("itnet_1", *FLAT) if name != "itnet"]
    sizes = ("data.sizes={train: 4, val: 1, test: 2}", "trainer.max_steps=2")
    check = ("trainer.val_check_interval=2", "device=cpu", "data.workers=0")
    table = train(
        TrainSettings(**compose("experiment=sparse_view", *small, *widths, *sizes, *check)),
        tmp_path,
    )
    assert set(table["methods"]) == {*FLAT, "itnet_1"}
    for name, row in table["methods"].items():
        assert isfinite(row["psnr"]["mean"])
        rows = read_rows(tmp_path / ("" if name == "itnet" else name) / "metrics.csv")
        errors = [float(row["val/loss_completed_views"] or 0) for row in rows]
        assert any(errors) == (name in ("sinogram_unet", "dual_domain"))
