"""RTK's methods reconstruct an asymmetric object in its position and unit."""

import pytest
import torch

from mvrecon.data.scenes.solids import Phantom, Solids, voxelise
from mvrecon.geometry.cameras.rigs import circular
from mvrecon.geometry.grid import Grid
from mvrecon.operators.drr import Drr
from mvrecon_peers import rtk_methods

VALUE = 0.02
METHODS = {
    "rtk_fdk": ({"cutoff": 0.0}, 0.1),
    "rtk_sirt": ({"iterations": 30}, 0.1),
    "rtk_os_sart": ({"iterations": 5}, 0.1),
    "rtk_cg": ({"iterations": 14}, 0.1),
    "rtk_tv": ({"iterations": 5, "gamma": 1e-4}, 0.1),
}


@pytest.mark.parametrize("name", METHODS)
def test_an_off_centre_ellipsoid_is_reconstructed_in_place_and_in_1_per_mm(name: str):
    pytest.importorskip("itk", reason="needs itk-rtk")
    grid = Grid.centred(size=(28, 24, 20), spacing=(4.0, 4.5, 5.0))
    rig = circular(45, 1000.0, 1500.0, {"pixels": [40, 44], "pixel_mm": 5.0}, start_degrees=7.0)
    centre, half = torch.tensor([[12.0, -20.0, 9.0]]), torch.tensor([[30.0, 22.0, 26.0]])
    ball = Solids("ellipsoid", centre, torch.eye(3)[None], half, torch.tensor([VALUE]))
    phantom = Phantom((ball,))
    views = phantom.integrals(*rig.rays(), ray_extent=rig.ray_extent)[None, None].float()
    options, limit = METHODS[name]
    volume = getattr(rtk_methods, name)(Drr(grid, rig), views, **options)[0, 0]
    middle = (
        voxelise(
            Phantom(
                (Solids("ellipsoid", centre, torch.eye(3)[None], half / 2, torch.tensor([1.0])),)
            ),
            grid,
        )
        == 1
    )
    outside = voxelise(phantom, grid) == 0
    assert volume[middle].mean().item() == pytest.approx(VALUE, rel=0.03)
    assert volume[outside].square().mean().sqrt().item() < limit * VALUE
