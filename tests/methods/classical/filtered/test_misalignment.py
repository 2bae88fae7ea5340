"""With known matrices, a misaligned scanner reconstructs the object in its position."""

import math
import warnings
from dataclasses import replace

import pytest
import torch

from mvrecon.data.scenes.solids import Phantom, Solids, voxelise
from mvrecon.geometry.cameras.camera import Cameras
from mvrecon.geometry.cameras.rigs import circular
from mvrecon.geometry.grid import Grid
from mvrecon.geometry.rigid import euler_rotation
from mvrecon.methods.classical.fdk import fbp, fdk
from mvrecon.operators.drr import Drr
from tests.methods.classical.filtered.scans import (
    SLICE,
    VALUE,
    cylinder,
    detector,
    middle,
    views_of,
)

GRID = Grid.centred(48, spacing=2.0)
RIG = circular(90, 400.0, 600.0, {"pixels": [64, 64], "pixel_mm": 2.5})


def disks() -> Phantom:
    """Defrise's: three disks across the axis, 12 mm thick."""
    centres = torch.tensor([[0.0, 0.0, z + 0.6] for z in (-24, 0, 24)])
    sizes, turns = torch.tensor([[35.0, 35.0, 6.0]]).expand(3, 3), torch.eye(3).expand(3, 3, 3)
    return Phantom((Solids("ellipsoid", centres, turns, sizes, torch.full((3,), 0.02)),))


def misaligned(rig: Cameras) -> Cameras:
    """Two pixels of offset, one degree of each tilt, sources off by 2 mm and 1 mm at random."""
    torch.manual_seed(0)
    turn = euler_rotation([1.0, -1.0, 1.0], "xyz")
    axes = torch.nn.functional.normalize(rig.frame, dim=-2)
    turn = axes @ turn @ torch.linalg.inv(axes)
    offset = 2 * rig.u - 2 * rig.v
    source = rig.source + 2.0 * axes[..., 0] + torch.randn(len(rig), 3, dtype=torch.float64)
    u, v = ((turn @ step[..., None])[..., 0] for step in (rig.u, rig.v))
    return replace(rig, source=source, origin=rig.origin + offset, u=u, v=v)


def test_true_matrices_restore_the_disks():
    """Weights and filter of the ideal rig do as well, as Karolczak and others have it."""
    truth, wrong = voxelise(disks(), GRID, 2), misaligned(RIG)
    views = views_of(disks(), wrong)
    volumes = {
        "aligned": fdk(Drr(GRID, RIG), views_of(disks(), RIG)),
        "ideal": fdk(Drr(GRID, RIG), views),
        "true": fdk(Drr(GRID, wrong), views),
        "back-projection": fdk(Drr(GRID, wrong), views, weights_from=RIG),
    }
    errors = {k: ((x[0, 0] - truth).norm() / truth.norm()).item() for k, x in volumes.items()}
    assert errors["ideal"] > 1.8 * errors["aligned"]
    assert errors["true"] < 1.1 * errors["aligned"]
    assert errors["back-projection"] == pytest.approx(errors["true"], rel=0.02)


@pytest.mark.parametrize(("deviation", "warned"), [(0.008, False), (0.012, True)])
def test_a_half_fan_warns_where_distances_of_its_sources_make_values_wrong_by_two_per_cent(
    deviation, warned
):
    """Of three periods a turn, the worst; against a cylinder in closed form. Also tried: 1 and 5
    periods, deviations of 0.5 to 4 %.
    """
    rig = circular(360, 400.0, 600.0, detector(66, 2.0, 35.0))
    turn = torch.arange(360, dtype=torch.float64) * 2 * math.pi / 360
    farther = (deviation * (3 * turn).sin())[:, None] * rig.source
    rig = replace(rig, source=rig.source + farther, origin=rig.origin + farther)
    with warnings.catch_warnings(record=True) as got:
        warnings.simplefilter("always")
        x = fbp(Drr(SLICE, rig), views_of(cylinder(), rig))
    error = (middle(x, SLICE, 35.0) / VALUE - 1).abs().max()
    assert (error > 0.02) == warned
    assert any("sources' distances" in str(one.message) for one in got) == warned
