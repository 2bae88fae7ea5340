import math

import pytest
import torch

from mvrecon.core.numbers import generator
from mvrecon.data.scenes.phantoms import RandomDerenzo, derenzo, sector_wells
from mvrecon.geometry.grid import Grid
from mvrecon.geometry.rigid import euler_rotation

DIAMETERS = (8, 6, 5, 4, 3, 2)


def test_the_usual_insert_has_73_wells():
    assert [len(sector_wells(d, 40)) for d in DIAMETERS] == [3, 3, 6, 10, 15, 36]
    (wells,) = derenzo().parts
    assert len(wells.values) == 73 and (wells.values == 1).all()


@pytest.mark.parametrize("diameter", [0.25, 2, 3, 4, 5, 6, 7.5, 8, 10])
def test_neighbours_stand_two_diameters_apart(diameter):
    xy = sector_wells(diameter, 40)
    apart = torch.cdist(xy, xy) + 1e9 * torch.eye(len(xy))
    if len(xy) > 1:
        torch.testing.assert_close(
            apart.amin(dim=1), torch.full((len(xy),), 2.0 * diameter, dtype=torch.float64)
        )
    assert (xy.norm(dim=1) + diameter / 2 <= 40).all()
    assert (xy[:, 0] > 0).all() and (xy[:, 1].abs() < xy[:, 0] * math.tan(math.pi / 6)).all()


@pytest.mark.parametrize(
    "diameters", [DIAMETERS, (2,) * 6, (8, 7.5, 7, 6, 5, 4), (0.5, 10, 0.5, 10, 0.5, 10)]
)
def test_wells_are_disjoint_and_inside_the_phantom(diameters):
    (wells,) = derenzo(diameters).parts
    xy, radii = wells.centres[:, :2], wells.semi_axes[:, 0]
    gap = torch.cdist(xy, xy) - radii - radii[:, None] + 1e9 * torch.eye(len(xy))
    assert gap.min() > 0
    assert (xy.norm(dim=1) + radii <= 40).all()


def test_the_sectors_go_round_counter_clockwise():
    (wells,) = derenzo().parts
    angles = torch.rad2deg(torch.atan2(wells.centres[:, 1], wells.centres[:, 0]))
    sector = torch.round(angles / 60).long() % 6
    for k, d in enumerate(DIAMETERS):
        assert (wells.semi_axes[sector == k, 0] == d / 2).all() and (sector == k).sum() == len(
            sector_wells(d, 40)
        )


def test_pose_and_background():
    R, t = euler_rotation((30, 40, 50)), torch.tensor([1.0, 2.0, 3.0], dtype=torch.float64)
    upright, turned = (
        derenzo(background=0.25),
        derenzo(centre=t.tolist(), euler_degrees=(30, 40, 50), background=0.25),
    )
    well = upright.parts[0].centres[1]
    between = torch.zeros(3, dtype=torch.float64)
    outside = torch.tensor([0.0, 0.0, 41.0], dtype=torch.float64)
    places = torch.stack([well, between, outside])
    assert upright.values(places).tolist() == [1, 0.25, 0]
    assert turned.values(places @ R.T + t).tolist() == [1, 0.25, 0]


def test_a_ray_along_the_axis_measures_the_height():
    phantom = derenzo(height=30, value=2.0)
    start = torch.nn.functional.pad(
        sector_wells(6, 40) @ euler_rotation((60, 0, 0))[:2, :2].T, (0, 1), value=-100.0
    )
    assert phantom.integrals(start, start * torch.tensor([1, 1, -1])).tolist() == pytest.approx(
        [60] * 3
    )


def test_sizes_in_voxels_are_the_same_on_every_grid():
    ratios = []
    for spacing in (1.0, 7.0):
        grid = Grid.centred((32, 32, 32), spacing)
        wells = RandomDerenzo().phantom(generator(0, 4), grid).parts[0]
        ratios.append(wells.semi_axes / spacing)
    torch.testing.assert_close(*ratios)
    assert ratios[0][:, 0].max() / ratios[0][:, 0].min() == pytest.approx(4)


def test_physical_size_is_preserved_or_refused():
    scene = RandomDerenzo(fill=None)
    assert (
        scene.phantom(generator(0, 0), Grid.centred((32, 32, 32), 5.0)).parts[0].semi_axes[0, 0]
        == 4
    )
    with pytest.raises(ValueError, match=r"field of radius 46.6\d* mm, got 29.4\d* mm"):
        scene.phantom(generator(0, 0), Grid.centred((32, 32, 32), 2.0))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"well_diameters": (8, 6, 5)}, "6 positive well diameters"),
        ({"well_diameters": (8, 6, 5, 4, 3, 0)}, "6 positive well diameters"),
        ({"well_diameters": (8, 6, 5, 4, 3, 30)}, "No well of diameter 30 mm fits"),
        ({"radius_mm": -40.0}, "positive radius"),
        ({"height_mm": 0.0}, "positive radius and height"),
        ({"background": 1.0}, "background"),
        ({"fill": (0.9, 1.1)}, "fill"),
        ({"fill": (0.9, 0.8)}, "fill"),
    ],
)
def test_invalid_options_are_refused(options, message):
    with pytest.raises(ValueError, match=message):
        RandomDerenzo(**options)
