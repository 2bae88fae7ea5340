"""Rays of a pixel: positions, number, and sensitivity compared with the closed form; grids that
extend beside and behind pinholes: only voxels in front contribute.
"""

import math
import warnings

import pytest
import torch

from mvrecon.core.parts import PROJECTORS
from mvrecon.geometry.cameras.camera import Cameras
from mvrecon.geometry.cameras.field import auto_grid
from mvrecon.geometry.cameras.rigs import dcspect80
from mvrecon.geometry.grid import Box, Grid, placed, voxel_centres
from mvrecon.operators.selection import ray_subset, view_subset
from mvrecon_spect.attenuated import ACROSS, AttenuatedTransform
from mvrecon_spect.files.stir_system import StirSystem, cameras_of
from mvrecon_spect.files.stir_text import CollimatorText, DetectorText, Opening, Ring
from mvrecon_spect.projector import Spect, sensitivity
from mvrecon_spect.rays import GENERATORS, offsets, rays_each_way, spread

COLUMNS = [2, 7, 12, 17]
BLUR = {"blur": True, "intrinsic_mm": 3.0}


def pack() -> Cameras:
    """STIR's pinhole pack: 91 holes of 1 mm over 270 degrees, 28.05 mm from the axis, before
    detectors of 104 x 104 pixels of 1 mm at 54.8 mm.
    """
    ring = Ring(91, 0.0, 3.0)
    holes = tuple(Opening(k, (0.0, 0.0, 0.0), "round", (1.0, 1.0)) for k in range(91))
    return cameras_of(
        StirSystem(
            shape=(104, 104),
            pixel_mm=(1.0, 1.0),
            radius_mm=54.8,
            detector=DetectorText(0.0, 0.0, 0.0, (ring,)),
            collimator=CollimatorText("pol", 28.05, 0.0, holes),
        )
    )


def law(
    cameras: Cameras, grid: Grid, diameter: float, edge: float
) -> tuple[torch.Tensor, torch.Tensor]:
    """Sensitivity of each voxel, the sum of d^2 cos^3(phi) / (16 h^2) over the cameras times its
    volume, and whether all cameras see it `edge` pixels inside of their detectors.
    """
    points = voxel_centres(grid).reshape(-1, 3)
    total, inside = torch.zeros(len(points)).double(), torch.ones(len(points)).bool()
    for camera in cameras:
        u, v, z = camera.project(points)[0].unbind(-1)
        away = (points - camera.source[0]).norm(dim=-1)
        total += diameter**2 * (-z / away) ** 3 / (16 * z**2)
        for place, count in zip((v, u), camera.shape, strict=True):
            inside &= (place >= edge - 0.5) & (place <= count - 0.5 - edge)
    return (total * math.prod(grid.spacing)).reshape(grid.shape), inside.reshape(grid.shape)


#: Rig, grid and hole; pixels by which blur and Joseph's rays reach over a detector's edge; the rays
#: each way that are at most half a voxel apart.
GRIDS = {
    "STIR's pack": (lambda: pack()[::8], Grid.centred(size=(56, 56, 6), spacing=0.5), 1.0, 4, 5),
    "16 cameras, 2.5 mm": (
        lambda: dcspect80(pixels=32, columns=COLUMNS),
        Grid.centred(64, spacing=2.5),
        2.3,
        6,
        5,
    ),
}


@pytest.mark.slow
@pytest.mark.parametrize("blur", [True, False])
@pytest.mark.parametrize("method", [None, "joseph"])
@pytest.mark.parametrize("name", GRIDS)
def test_sensitivity_is_within_2_percent_of_the_formula_in_the_field(name, method, blur):
    rig, grid, diameter, edge, each_way = GRIDS[name]
    A = Spect(grid, rig(), diameter, blur=blur, **({"method": method} if method else {}))
    if method:
        assert (A.A.rays_per_pixel if blur else A.A.n) == each_way
    else:
        assert A.A.method == "distance_driven"
    expected, inside = law(A.cameras, grid, diameter, edge)
    for axis in range(3):  # half of a voxel at the grid's face is beyond it
        inside.select(axis, 0)[:] = inside.select(axis, -1)[:] = False
    assert int(inside.sum()) > 10_000
    share = (A.T(torch.ones(1, 1, *A.range_shape).double())[0, 0] / expected)[inside]
    assert 0.98 < share.min().item() and share.max().item() < 1.02
    assert share.mean().item() == pytest.approx(1, abs=1e-3)


def test_one_ray_per_pixel_is_inaccurate_for_rays_wider_apart_than_voxels():
    rig, grid, diameter, edge, _ = GRIDS["16 cameras, 2.5 mm"]
    A = Spect(grid, rig(), diameter, blur=True, rays_per_pixel=1)
    expected, inside = law(A.cameras, grid, diameter, edge)
    share = (A.T(torch.ones(1, 1, *A.range_shape))[0, 0] / expected)[inside]
    assert share.std().item() > 0.3 and share.min().item() < 0.1


@pytest.mark.parametrize("n", range(1, len(GENERATORS) + 1))
def test_rays_are_evenly_distributed_about_the_pixel_centre(n):
    places = offsets(n)
    torch.testing.assert_close(places.mean(dim=0), torch.zeros(2).double())
    assert places.abs().max().item() < 0.5
    for along in places.unbind(dim=1):  # a square array has n of n rays in a row
        assert len(along.unique()) >= n * n / math.gcd(GENERATORS[n - 1], n * n) >= n * n / 4
    assert len({tuple(place) for place in places.tolist()}) == n * n
    rig = spread(dcspect80(pixels=4)[[0, 30]], n)
    middle = rig.detector_centre.unflatten(0, (2, -1)).mean(dim=1)
    torch.testing.assert_close(middle, dcspect80(pixels=4)[[0, 30]].detector_centre)


@pytest.mark.parametrize(
    ("pixels", "voxel", "each_way"), [(64, 5.0, 1), (32, 8.0, 2), (32, 5.0, 2), (32, 2.5, 5)]
)
def test_rays_are_spaced_by_half_a_voxel(pixels, voxel, each_way):
    grid = Grid.centred(20, spacing=voxel)
    assert rays_each_way("auto", dcspect80(pixels=pixels), grid) == each_way
    assert rays_each_way(7, dcspect80(pixels=pixels), grid) == 7


@pytest.mark.parametrize("method", ["joseph", "siddon", "distance_driven"])
@pytest.mark.parametrize("blur", [{}, {"blur": True, "intrinsic_mm": 4.0}])
def test_adjoints_match_in_wide_pixels_attenuated_and_blurred(method, blur):
    torch.manual_seed(0)
    grid = Grid.centred(size=(10, 9, 8), spacing=12.0)
    rig = dcspect80(pixels=[12, 10], columns=[0, 5, 11], rows=[0, 1])
    mu, x = 0.03 * torch.rand(grid.shape), torch.rand(1, 2, *grid.shape).double()
    rays, results = 1 if method == "distance_driven" else 3, []
    for backend in ("cpu", "reference"):
        m = mu.double().requires_grad_()
        A = Spect(grid, rig, 6.0, m, **blur, method=method, backend=backend, rays_per_pixel=rays)
        y = A(x)
        z = torch.linspace(-1, 2, y.numel()).double().reshape(y.shape)
        back = A.T(z)
        assert (y * z).sum().item() == pytest.approx((x * back).sum().item(), rel=1e-12)
        results.append((y, back, torch.autograd.grad((y * z).sum(), m)[0]))
        torch.testing.assert_close(view_subset(A, [4, 1])(x), y[:, :, [4, 1]])
    for one, other in zip(*results, strict=True):
        assert (one - other).norm() <= 1e-12 * other.norm()


@pytest.mark.parametrize("pixel", [{"rays_per_pixel": 6}, {"method": "distance_driven"}])
@pytest.mark.parametrize("blur", [{}, {"blur": True, "intrinsic_mm": 7.0}])
def test_a_pixel_is_the_sum_of_its_rays_weighted_by_solid_angle(blur, pixel):
    """Where the cone of acceptance ends within pixels, they count as much as the part inside;
    distance-driven ones with the mean of their activity.
    """
    rig, grid = dcspect80(pixels=8, columns=[9], rows=[1]), Grid.centred(8, spacing=30.0)
    ones = torch.ones(1, 1, *grid.shape).double()
    cone = {"acceptance_degrees": 15.0}
    y = Spect(grid, rig, 2.3, **pixel, **cone, **blur)(ones)
    fine = Spect(grid, rig.refined(6), 2.3, rays_per_pixel=1, **cone)(ones)
    expected = 36 * torch.nn.functional.avg_pool2d(fine[0], 6)[None]
    areas = "method" in pixel
    if not blur and not areas:
        torch.testing.assert_close(y, expected, rtol=0.02, atol=0.05 * expected.max().item())
    assert y.sum().item() == pytest.approx(expected.sum().item(), rel=0.02 if areas else 0.015)


@pytest.mark.parametrize("rays", [0, -1, 9, 2.0, True, "many", None])
def test_an_impossible_number_of_rays_is_refused(rays):
    """A number of rays a pixel that is not "auto" or 1 to 8 is refused."""
    grid = Grid.centred(8, spacing=12.0)
    with pytest.raises(ValueError, match="rays each way in a pixel, as auto or a whole number"):
        Spect(grid, dcspect80(pixels=4), rays_per_pixel=rays)


@pytest.mark.parametrize("rays", [1, 2])
def test_a_finer_grid_keeps_the_attenuation(rays):
    """Attenuation is that of the coarse voxels, and rays are as much closer."""
    grid, rig = Grid.centred(8, spacing=12.0), dcspect80(pixels=6, columns=[3], rows=[0])
    mu = 0.03 * torch.rand(grid.shape, generator=torch.Generator().manual_seed(0))
    x = torch.rand(1, 1, *grid.refined(2).shape).double()
    options = {"method": "siddon", "rays_per_pixel": rays}
    mean = Spect(grid, rig, mu=mu, **options).refined(2)(x)
    fine = mu.repeat_interleave(2, 0).repeat_interleave(2, 1).repeat_interleave(2, 2)
    if rays == 1:
        A = AttenuatedTransform(grid.refined(2), rig, fine, method="siddon", rays_per_pixel=2)
        expected = A(x) * sensitivity(rig, 2.3)
    else:
        expected = Spect(grid.refined(2), rig, mu=fine, method="siddon", rays_per_pixel=4)(x)
    torch.testing.assert_close(mean, expected)
    assert (Spect(grid.refined(2), rig, **options)(x) - mean).norm() > 0.2 * mean.norm()


@pytest.mark.parametrize("pixel", [{"rays_per_pixel": 2}, {"method": "distance_driven"}])
@pytest.mark.parametrize("mu", [None, 0.01])
def test_subsets_crops_supports_and_bins_match_the_full_operator(mu, pixel):
    torch.manual_seed(0)
    grid = Grid.centred(size=(10, 9, 8), spacing=12.0)
    rig = dcspect80(pixels=[6, 5], columns=[0, 5, 11], rows=[0, 1])
    A = Spect(grid, rig, mu=mu, **pixel)
    x = torch.rand(1, 1, *grid.shape).double()
    y = A(x)
    chosen = torch.rand(A.range_shape) < 0.3
    bins = ray_subset(A, chosen)
    torch.testing.assert_close(bins(x)[0, 0], y[0, 0][chosen])
    values = torch.rand(1, 1, int(chosen.sum())).double()
    whole = torch.zeros_like(y)
    whole[:, :, chosen] = values
    torch.testing.assert_close(bins.T(values), A.T(whole))
    torch.testing.assert_close(view_subset(A, [4, 1])(x), y[:, :, [4, 1]])
    box = Box((1, 2, 3), (8, 9, 10))
    part = A.cropped(box, [5, 0])
    torch.testing.assert_close(
        part(x[:, :, *box.slices]), A(placed(x[:, :, *box.slices], box, grid.shape))[:, :, [5, 0]]
    )
    assert len(part.cameras) == 2
    support = torch.rand(grid.shape) > 0.5
    torch.testing.assert_close(A.with_support(support)(x), A(x * support))
    integral = A.pixel_integral()
    if mu is None:
        assert integral.rays == (2 if "rays_per_pixel" in pixel else ACROSS)
        torch.testing.assert_close(integral.weight, sensitivity(rig, 2.3), rtol=0.05, atol=0)
    else:
        assert integral is None and torch.equal(A.mu_map(), torch.full(grid.shape, mu))


def behind(rig, grid, by=0.0):
    """Which voxel centres are so many voxels' diagonals behind each pinhole's plane [m d h w]."""
    return rig.project(voxel_centres(grid))[..., 2] >= by * math.hypot(*grid.spacing)


def long_grid(rig, reach):
    """A grid of voxels of 8 mm about the axis of a pinhole, from 100 mm before its plane to `reach`
    mm behind it, and the index of a voxel 64 mm before it.
    """
    axis = torch.nn.functional.normalize(rig.source[0], dim=0)
    far = rig.source[0] - 100 * axis
    across = torch.nn.functional.normalize(rig.u[0], dim=0)
    down = torch.linalg.cross(axis, across)
    affine = torch.eye(4, dtype=torch.float64)
    affine[:3, :3] = 8 * torch.stack([across, down, axis], dim=1)
    count = (100 + reach) // 8
    affine[:3, 3] = far - 8 * (3.5 * across + 3.5 * down) + 2 * across + 60 * across
    grid = Grid((count, 8, 8), affine)
    return grid, (4, 4, 3)


@pytest.mark.parametrize("options", [{}, BLUR, {**BLUR, "mu": 0.01}])
@pytest.mark.filterwarnings("ignore:The grid reaches behind")
def test_voxels_behind_the_pinhole_do_not_contribute(options):
    """The grid is beside the pinhole and extends 64 mm behind it."""
    rig = dcspect80(pixels=40, field=3.0)[[30]]
    (short, point), (long, _) = long_grid(rig, -16), long_grid(rig, 64)
    views = []
    for grid in (short, long):
        A = Spect(grid, rig, 2.3, **options, rays_per_pixel=2)
        x = torch.zeros(1, 1, *grid.shape).double()
        x[0, 0][point] = 1
        views.append(A(x)[0, 0, 0])
        y = torch.rand(1, 1, *A.range_shape, generator=torch.Generator().manual_seed(0)).double()
        x = torch.rand(x.shape, generator=torch.Generator().manual_seed(1)).double()
        assert (A(x) * y).sum().item() == pytest.approx((x * A.T(y)).sum().item(), rel=1e-12)
    assert views[0].sum().item() > 0
    assert views[1].sum().item() == pytest.approx(views[0].sum().item(), rel=1e-6)
    place = torch.arange(40).double()
    moments = [
        ((view.sum(dim=k) * place**2).sum() - (view.sum(dim=k) * place).sum() ** 2 / view.sum())
        / view.sum()
        for k in (0, 1)
        for view in views
    ]
    assert moments[1].item() == pytest.approx(moments[0].item(), rel=0.01)
    assert moments[3].item() == pytest.approx(moments[2].item(), rel=0.01)
    hidden = behind(rig, long, by=1)[0]
    assert hidden.sum() > 200
    assert not A(hidden[None, None].double()).any()
    assert not A.T(torch.ones(1, 1, *A.range_shape).double())[0, 0][hidden].any()


@pytest.mark.parametrize("blur", [{}, {"blur": True}])
def test_a_subset_of_cameras_on_such_a_grid_matches_the_full_operator(blur):
    rig, grid = dcspect80(pixels=16, columns=[0, 5, 9]), Grid.centred(16, spacing=20.0)
    with pytest.warns(UserWarning, match="The grid reaches behind"):
        A = Spect(grid, rig, **blur)
    x = torch.rand(1, 1, *grid.shape).double()
    y = A(x)
    torch.testing.assert_close(view_subset(A, [7, 1])(x), y[:, :, [7, 1]])
    for k, one in enumerate(behind(rig, grid, by=1)):
        assert not A(one[None, None].double())[0, 0, k].any()


def test_invisible_voxels_raise_one_warning_unless_outside_the_support():
    """One for all operators of a grid and its refinements, as a simulation builds both."""
    rig, grid = dcspect80(pixels=8), Grid.centred(20, spacing=16.0)
    hidden = behind(rig, grid)
    share = behind(rig, Grid.centred(32, spacing=10.0)).double().mean((1, 2, 3))  # same box
    count, most = int((share > 0).sum()), 100 * share.max().item()
    told = f"behind {count} of 80 pinholes, .*: up to {most:.2g} % of the voxels"
    with pytest.warns(UserWarning, match=told):
        Spect(grid, rig)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("default")
        Spect(grid, rig, blur=True)
        Spect(grid.refined(2), rig, mu="case").for_case({"mu": torch.zeros(1, 1, 40, 40, 40)})
        PROJECTORS.build("spect", grid=grid.refined(3), cameras=rig.refined(3))
    assert len([w for w in caught if "reaches behind" in str(w.message)]) == 1
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        Spect(grid, rig, support=~hidden.any(dim=0))
        Spect(Grid.centred(20, spacing=8.0), rig, blur=True)


@pytest.mark.filterwarnings("ignore:The grid reaches behind")
@pytest.mark.parametrize(
    ("rig", "grid"),
    [
        (lambda: dcspect80(pixels=16), Grid.centred(16, spacing=16.0)),  # events
        (lambda: dcspect80(pixels=16), Grid.centred(16, spacing=20.0, centre=(40, -40, 0))),
        (pack, Grid.centred(size=(92, 92, 120), spacing=0.5)),  # pinholes in the box's corners
        (pack, None),
        (lambda: dcspect80(pixels=16), None),
    ],
    ids=["events", "events_cardiac", "STIR's own grid", "automatic, STIR", "automatic, dcspect80"],
)
def test_boxes_beside_pinholes_are_projected_with_blur_and_attenuation(rig, grid):
    cameras = rig()[::9]
    grid = auto_grid(cameras) if grid is None else grid
    A = Spect(grid, cameras, 1.0, mu=0.01, blur=True, intrinsic_mm=4.0, rays_per_pixel=1)
    assert all(block.magnification.shape[1] <= 24 for block in A.A.blocks)
    x = torch.rand(1, 1, *grid.shape)
    y = A(x)
    z = torch.rand_like(y)
    assert (y * z).double().sum().item() == pytest.approx(
        (x * A.T(z)).double().sum().item(), rel=1e-5
    )
    sharp = Spect(grid, cameras, 1.0, mu=0.01, rays_per_pixel=1)
    middle = (voxel_centres(grid) - grid.centre).norm(dim=-1) < 12
    ball = middle[None, None].float()
    assert A(ball).sum().item() == pytest.approx(sharp(ball).sum().item(), rel=0.01)
    assert math.isfinite(y.sum().item())
