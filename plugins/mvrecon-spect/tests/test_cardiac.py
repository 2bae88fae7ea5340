"""Patients of the cardiac scene: the heart where its numbers say, organs that do not overlap, water
and lung.
"""

import math

import pytest
import torch

from mvrecon.core.numbers import generator
from mvrecon.data.scenes.solids import Phantom, voxelise
from mvrecon.geometry.grid import Grid
from mvrecon.geometry.rigid import euler_rotation
from mvrecon_spect.scenes.cardiac import LUNG, WATER, Defect, Heart, RandomCardiac, Uptake

GRID = Grid.centred((64, 64, 64), 5.0, centre=(40, -40, 0))
#: Numbers without a defect: a share 0 of cases.
WELL = RandomCardiac(defects=0.0)
ILL = RandomCardiac(defects=1.0)


def points(*places):
    return torch.tensor(places, dtype=torch.float64)


def test_wall_and_defect_have_their_expected_volumes():
    grid = Grid.centred((56, 56, 56), 2.0, centre=(0, 0, 36))
    defect = Defect(40, 90, 20 / 73, 44 / 73, 0.7)  # planes between the points of voxels
    whole, ill = (
        voxelise(Phantom(Heart(defect=d).solids(Uptake(right=0.0))), grid, 4).double()
        for d in (Defect(), defect)
    )
    wall = 2 / 3 * math.pi * (31**2 * 73 - 21**2 * 63)
    assert whole.sum().item() * 8 == pytest.approx(wall, rel=3e-3)
    # a quarter turn of the outer ellipsoid between the planes, less that of the inner one
    volumes = [
        math.pi * a**2 * ((high - low) - (high**3 - low**3) / (3 * c**2))
        for a, c, low, high in ((31, 73, 20, 44), (21, 63, 20, 44))
    ]
    lost = 0.7 * (volumes[0] - volumes[1]) / 4
    assert (whole - ill).sum().item() * 8 == pytest.approx(lost, rel=1e-2)
    assert ill.min() > -1e-6


def test_the_parameters_of_a_case_locate_the_heart():
    for index in range(8):
        p = ILL.parameters(index, 0, GRID)
        R = euler_rotation([p["phi_degrees"], p["theta_degrees"], p["psi_degrees"]])
        t = points((p["x_mm"], p["y_mm"], p["z_mm"]))
        phantom = ILL.phantom(generator(0, index), GRID)
        radius, length, wall = p["radius_mm"], p["length_mm"], p["wall_mm"]
        blood = points((0, 0, length / 2))[0]
        middle = length * (p["defect_low"] + p["defect_high"]) / 2
        turn = math.radians(p["defect_azimuth_degrees"])
        rim = radius * math.sqrt(1 - (middle / length) ** 2) - wall / 3
        scar = points((rim * math.cos(turn), rim * math.sin(turn), middle))[0]
        other = scar * points((-1, -1, 1))[0]
        values = phantom.values(torch.stack([blood, scar, other]) @ R.T + t)
        ill = 1 - p["defect_contrast"]
        assert values.tolist() == pytest.approx([p["uptake_body"], ill, 1.0])
        assert 0.1 - 1e-9 <= 1 - ill <= 0.9


def test_organs_are_disjoint_and_attenuate_like_water_and_lung():
    for index in range(4):
        volume = voxelise(WELL.phantom(generator(1, index), GRID), GRID, 2)
        assert volume.min() >= 0 and volume.max() <= 1 + 1e-6
        mu = WELL.maps(index, 1, GRID)["mu"]
        levels = [(mu - level).abs() < 1e-6 for level in (0.0, LUNG, WATER)]
        assert all(level.float().mean() > 0.02 for level in levels)
        assert (mu[0][volume == 0] < WATER).all() and mu.max() <= WATER + 1e-6
    assert not RandomCardiac(attenuates=False).maps(0, 1, GRID)["mu"].any()


def test_half_of_the_cases_have_a_defect():
    cases = [RandomCardiac().parameters(k, 5, GRID)["defect_contrast"] for k in range(60)]
    assert 18 <= sum(c > 0 for c in cases) <= 42
    assert min(c for c in cases if c > 0) >= 0.3


def test_a_grid_without_room_for_the_torso_is_refused():
    """A grid that cuts a patient's torso off is refused, with one that does not."""
    with pytest.raises(ValueError, match=r"holds a torso of \[311, 240, 240\] mm.*spacing=5"):
        WELL.phantom(generator(0, 0), Grid.centred((64, 64, 64), 4.0))


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: RandomCardiac(defects=2), "share of defects"),
        (lambda: RandomCardiac(contrast=(0.9, 0.3)), "contrasts that ascend"),
        (lambda: Defect(width_degrees=180), "0 to 180 degrees"),
        (lambda: Defect(low=0.7, high=0.3), "ends that ascend"),
        (lambda: Heart(wall=40), "walls below"),
    ],
)
def test_invalid_sizes_are_refused(make, message):
    with pytest.raises(ValueError, match=message):
        make()
