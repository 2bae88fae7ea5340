"""ASTRA's methods reconstruct an off-centre object in its position and unit."""

import pytest
import torch

from mvrecon.data.scenes.solids import Phantom, Solids, voxelise
from mvrecon.geometry.cameras.rigs import parallel
from mvrecon.geometry.grid import Grid
from mvrecon.operators.radon import Radon
from mvrecon_peers import astra_methods

VALUE = 0.02
METHODS = {
    "astra_fbp": ({"filter": "hann"}, 0.1),
    "astra_sirt": ({"iterations": 40}, 0.1),
    "astra_cgls": ({"iterations": 12}, 0.1),
}


def cylinder(radius: float) -> Phantom:
    one, axes = torch.tensor([VALUE]), torch.eye(3)[None]
    centre, half = torch.tensor([[12.0, -20.0, 0.0]]), torch.tensor([[radius, radius - 8, 500.0]])
    return Phantom((Solids("ellipsoid", centre, axes, half, one),))


@pytest.mark.parametrize("name", METHODS)
def test_an_off_centre_ellipse_is_reconstructed_in_place_and_in_1_per_mm(name: str):
    pytest.importorskip("astra", reason="needs astra-toolbox")
    grid = Grid.centred(size=(40, 36, 2), spacing=4.0)
    rig = parallel(60, {"pixels": [2, 56], "pixel_mm": 4.0}, start_degrees=7.0)
    phantom, (options, limit) = cylinder(36.0), METHODS[name]
    views = phantom.integrals(*rig.rays(), ray_extent=rig.ray_extent)[None, None].float()
    volume = getattr(astra_methods, name)(Radon(grid, rig), views, **options)[0, 0]
    middle = voxelise(cylinder(18.0), grid) > 0.99 * VALUE
    outside = voxelise(phantom, grid) == 0
    assert volume[middle].mean().item() == pytest.approx(VALUE, rel=0.02)
    assert volume[outside].square().mean().sqrt().item() < limit * VALUE
