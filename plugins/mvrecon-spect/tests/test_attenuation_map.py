"""Attenuation of a map on its own grid, by the closed form of a cylinder about the activity."""

import math

import pytest
import torch

from mvrecon.data.volume_files import save_volume
from mvrecon.geometry.cameras.rigs import dcspect80
from mvrecon.geometry.grid import Grid, voxel_centres
from mvrecon.testing import derivative_gap
from mvrecon_spect.operators.projector import Spect

WATER, RADIUS = 0.01536, 100.0
MAP = Grid.centred(size=(56, 56, 76), spacing=4.0)


def turned(degrees: float) -> Grid:
    """A grid of 24 mm beside the axis, turned about z."""
    cosine, sine = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
    turn = torch.tensor([[cosine, -sine, 0], [sine, cosine, 0], [0, 0, 1]], dtype=torch.float64)
    place = torch.tensor([-30.0, 20.0, 10.0], dtype=torch.float64)
    return Grid.centred(6, spacing=4.0).moved(turn, place)


#: Grids of the activity, all with a voxel's centre where the point is.
GRIDS = {
    "small, in the middle": Grid.centred(5, spacing=4.0),
    "small, beside the axis": Grid.centred(5, spacing=4.0, centre=(40.0, -20.0, 30.0)),
    "turned": turned(30.0),
    "as large as the cylinder": Grid.centred(51, spacing=4.0),
    "larger than the map": Grid.centred(size=(71, 71, 81), spacing=4.0),
}


def disc(inner: float, outer: float) -> torch.Tensor:
    """Water between two radii about z on the map's grid, by parts of voxels on the surfaces."""
    fine = Grid.centred(size=(56 * 8, 56 * 8, 1), spacing=0.5)
    radius = voxel_centres(fine)[..., :2].norm(dim=-1)
    parts = ((radius >= inner) & (radius < outer)).double()
    return WATER * torch.nn.functional.avg_pool2d(parts, 8).expand(MAP.shape).float()


def way_in_water(point: torch.Tensor, towards: torch.Tensor, radius: float) -> torch.Tensor:
    """Mm from a point in a long cylinder about z to its surface, on the way to each place."""
    along = torch.nn.functional.normalize(towards - point, dim=-1)
    a, b = (along[:, :2] ** 2).sum(-1), (along[:, :2] * point[:2]).sum(-1)
    return (-b + (b**2 + a * (radius**2 - (point[:2] ** 2).sum())).sqrt()) / a


def transmission(grid: Grid, path, **options) -> tuple[torch.Tensor, torch.Tensor]:
    """Counts of a voxel at the grid's middle with the map over those without, of each camera, and
    the voxel's centre.
    """
    cameras = dcspect80(pixels=48, columns=[0, 5, 10, 15, 19], rows=[0, 2])
    place = tuple(n // 2 for n in grid.shape)
    x = torch.zeros(1, 1, *grid.shape)
    x[0, 0][place] = 1
    y, clear = (Spect(grid, cameras, mu=mu, **options)(x).sum(dim=(-2, -1)) for mu in (path, None))
    return (y / clear)[0, 0].double(), voxel_centres(grid)[place]


@pytest.mark.filterwarnings("ignore:The grid reaches behind")
@pytest.mark.pairwise(name=GRIDS, options=[{}, {"blur": True, "intrinsic_mm": 3.0}])
def test_a_map_attenuates_beyond_the_grid_of_the_activity(tmp_path, name, options):
    save_volume(tmp_path / "mu.nii.gz", disc(0, RADIUS), MAP)
    seen, point = transmission(GRIDS[name], tmp_path / "mu.nii.gz", **options)
    cameras = dcspect80(pixels=48, columns=[0, 5, 10, 15, 19], rows=[0, 2])
    expected = (-WATER * way_in_water(point, cameras.source, RADIUS)).exp()
    torch.testing.assert_close(seen, expected, rtol=0.01, atol=0)
    assert expected.max() < 0.6  # without the map beyond a small grid it would be 0.96


def test_matter_around_the_grid_attenuates_and_matter_beside_it_is_refused(tmp_path):
    grid, path = GRIDS["small, beside the axis"], tmp_path / "mu.nii.gz"
    save_volume(path, disc(70, RADIUS), MAP)
    seen, point = transmission(grid, path)
    cameras = dcspect80(pixels=48, columns=[0, 5, 10, 15, 19], rows=[0, 2])
    inner, outer = (way_in_water(point, cameras.source, r) for r in (70.0, RADIUS))
    torch.testing.assert_close(seen, (-WATER * (outer - inner)).exp(), rtol=0.02, atol=0)
    elsewhere = MAP.moved(torch.eye(3).double(), torch.tensor([400.0, 0, 0]).double())
    save_volume(path, disc(0, RADIUS), elsewhere)
    with pytest.raises(ValueError, match="got all of it elsewhere"):
        Spect(grid, cameras, mu=path)


@pytest.mark.parametrize(
    ("slices", "told"), [((0, 76), False), ((30, 76), True), ((0, 50), True), ((8, 68), False)]
)
def test_a_map_that_ends_within_body_and_grid_is_told(tmp_path, recwarn, slices, told):
    """A CT of fewer slices than the activity has. Also tried: an end within the grid in air, along
    x, and less than a voxel before the grid's end; a map turned by 30 degrees.
    """
    first, last = slices
    affine = MAP.affine.clone()
    affine[:3, 3] = MAP.to_world(torch.tensor([0.0, 0, first]).double())
    short = Grid((last - first, *MAP.shape[1:]), affine)
    body = disc(0, RADIUS)
    body[:8] = body[68:] = 0  # air at both ends of the map
    body[first if told else 8] = body[last - 1 if told else 67] = WATER
    save_volume(tmp_path / "mu.nii.gz", body[first:last], short)
    grid = Grid.centred(size=(20, 20, 59), spacing=4.0)
    Spect(grid, dcspect80(pixels=8, columns=[0]), mu=tmp_path / "mu.nii.gz")
    found = [w for w in recwarn if "expected a map of the whole body" in str(w.message)]
    assert bool(found) is told


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16, torch.float64])
def test_a_map_of_any_precision_attenuates_alike(dtype):
    """Tables of integrals are of single or double precision, whatever the map's."""
    grid, rig = Grid.centred(10, spacing=12.0), dcspect80(pixels=8, columns=[0])
    mu, x = torch.full(grid.shape, 0.015625), torch.rand(1, 1, *grid.shape)
    expected = Spect(grid, rig, mu=mu)(x)
    torch.testing.assert_close(Spect(grid, rig, mu=mu.to(dtype))(x), expected)


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16, torch.float64])
def test_casting_an_operator_keeps_its_map(dtype):
    """As of a network in half precision that holds it; the map remains that of its owner, whose
    changes are followed. Tried too: copies, subsets and operators of cases, and back to float32.
    """
    grid, rig = Grid.centred(10, spacing=12.0), dcspect80(pixels=8, columns=[0])
    mu, x = 0.005 + 0.01 * torch.rand(grid.shape), torch.rand(1, 1, *grid.shape)
    A = Spect(grid, rig, mu=mu).to(dtype)
    for _ in range(2):
        assert torch.equal(A(x), Spect(grid, rig, mu=mu)(x))
        mu.mul_(0.5)


def test_an_operator_built_in_inference_mode_has_gradients():
    grid, rig = Grid.centred(6, spacing=20.0), dcspect80(pixels=8, columns=[0], rows=[0])
    with torch.inference_mode():
        operators = [Spect(grid, rig), Spect(grid, rig, mu=0.01)]
    x, y = torch.rand(1, 1, *grid.shape).double(), torch.rand(1, 1, 1, 8, 8).double()
    for A in operators:
        assert derivative_gap(A, x, y) < 1e-12
