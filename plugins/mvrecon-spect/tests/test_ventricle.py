import math

import pytest
import torch

from mvrecon.core.numbers import generator
from mvrecon.data.scenes.analytic import render
from mvrecon.data.scenes.solids import voxelise
from mvrecon.geometry.cameras.rigs import parallel
from mvrecon.geometry.grid import Grid
from mvrecon.geometry.rigid import euler_rotation
from mvrecon_spect.scenes.ventricle import RandomVentricle, ventricle

#: 4/3 pi (a b c - (a - w)(b - w)(c - w)) in mm^3.
WALL = 4 / 3 * math.pi * (32 * 32 * 45 - 22 * 22 * 35)


def points(*places):
    return torch.tensor(places, dtype=torch.float64)


def test_a_ray_crosses_the_wall_twice():
    heart = ventricle(value=2.0)
    ends = points((0, 0, 100), (100, 0, 0), (0, -100, 0))
    assert heart.integrals(-ends, ends).tolist() == pytest.approx(
        [2 * 20] * 3
    )  # 10 mm in, 10 mm out
    beside = points(
        (27, 0, 100)
    )  # outside of the cavity's radius of 22 mm: one chord, of the outer surface alone
    chord = 2 * 45 * math.sqrt(1 - (27 / 32) ** 2)
    assert heart.integrals(beside, beside * points((1, 1, -1))).item() == pytest.approx(2 * chord)


def test_blood_fills_only_the_cavity():
    places = points((0, 0, 0), (0, 0, 34), (0, 0, 40), (0, 0, 46), (27, 0, 0))
    assert ventricle(value=4.0).values(places).tolist() == [0, 0, 4, 0, 4]
    assert ventricle(value=4.0, blood=0.25).values(places).tolist() == [1, 1, 4, 0, 4]


def test_pose():
    R, t = euler_rotation((30, 40, 50)), points(1, 2, 3)
    places = points((0, 0, 40), (27, 0, 0), (0, 0, 46), (0, 0, 0))
    turned = ventricle(centre=t.tolist(), euler_degrees=(30, 40, 50))
    assert turned.values(places @ R.T + t).tolist() == [1, 1, 0, 0]


def test_voxels_conserve_the_mass_of_the_wall_with_an_empty_cavity():
    """0.7 % of a cube of 256 mm; the cavity cancels to the last bit."""
    grid = Grid.centred((64, 64, 64), 4.0)
    heart = RandomVentricle().phantom(generator(0, 1), grid)
    volume = voxelise(heart, grid)
    assert volume.sum().item() * 64 == pytest.approx(WALL, rel=5e-3)
    assert volume.sum().item() / 64**3 == pytest.approx(0.0073, abs=1e-4)
    assert volume.min() == 0 and volume.max() == 1
    z, y, x = (grid.to_index(heart.parts[0].centres[0]).round().long()).flip(0).tolist()
    assert (volume[z - 2 : z + 3, y - 2 : y + 3, x - 2 : x + 3] == 0).all()


def test_exact_views_conserve_the_mass():
    """A parallel view's rays, 5/3 mm apart, add up to the wall's volume; the cavity is of the
    object, and empty.
    """
    grid = Grid.centred((24, 24, 24), 5.0)
    rig = parallel(2, detector={"pixels": [72, 72], "pixel_mm": 5 / 3})
    sample = render(ventricle(euler_degrees=(20, 50, 0)), grid, rig, "heart")
    for view in sample.views[0]:
        assert view.sum().item() * (5 / 3) ** 2 == pytest.approx(WALL, rel=5e-3)
    assert sample.inside[0, 12, 12, 12] and sample.volume[0, 12, 12, 12] == 0


def test_cases_differ_in_pose_and_stay_in_the_field_of_view():
    grid, scene = Grid.centred((32, 32, 32), 4.0, centre=(10, 20, 30)), RandomVentricle()
    hearts = [scene.phantom(generator(3, index), grid) for index in range(20)]
    for heart in hearts:
        (solids,) = heart.parts
        assert (solids.centres - grid.centre).norm(dim=1).max() + 45 <= scene.radius(grid) + 1e-9
        assert solids.semi_axes.tolist() == [[32, 32, 45], [22, 22, 35]]
    assert len({tuple(heart.parts[0].rotations[0, 2].tolist()) for heart in hearts}) == 20


def test_a_field_of_view_that_is_too_small_is_refused():
    with pytest.raises(ValueError, match=r"45 mm needs a field of that radius, got 29.4\d* mm"):
        RandomVentricle().phantom(generator(0, 0), Grid.centred((32, 32, 32), 2.0))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"semi_axes_mm": (32, 45)}, "three semi-axes"),
        ({"semi_axes_mm": (32, 32, 9)}, "above a positive wall"),
        ({"wall_mm": 0}, "above a positive wall"),
        ({"wall_mm": 32}, "above a positive wall"),
        ({"blood": 1.0}, "blood"),
    ],
)
def test_invalid_options_are_refused(options, message):
    with pytest.raises(ValueError, match=message):
        RandomVentricle(**options)
