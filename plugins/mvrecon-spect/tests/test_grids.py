"""Sensitivity compared with the closed form; grids that extend beside and behind pinholes: only
voxels in front contribute.
"""

import math
import warnings

import pytest
import torch

from mvrecon.core.parts import PROJECTORS
from mvrecon.data.volume_files import save_volume
from mvrecon.geometry.cameras.camera import Cameras
from mvrecon.geometry.cameras.field import auto_grid
from mvrecon.geometry.cameras.rigs import dcspect80
from mvrecon.geometry.grid import Grid, voxel_centres
from mvrecon.operators.selection import ray_subset, view_subset
from mvrecon_spect.files.stir_system import StirSystem, cameras_of
from mvrecon_spect.files.stir_text import CollimatorText, DetectorText, Opening, Ring
from mvrecon_spect.operators.projector import Spect, sensitivity

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


@pytest.mark.parametrize("blur", [{}, {"blur": True}])
def test_the_sensitivity_of_a_rig_is_the_formula(blur):
    """STIR's pack; single cameras are in test_footprints.py."""
    rig, grid = pack()[::8], Grid.centred(size=(56, 56, 6), spacing=0.5)
    sums, inside = law(rig, grid, 1.0, 4)
    A = Spect(grid, rig, 1.0, **blur)
    ratio = (A.T(torch.ones(1, 1, *A.range_shape).double())[0, 0] / sums)[inside]
    assert len(ratio) > 1000
    assert 0.998 < ratio.min() <= ratio.max() < 1.002


def test_a_finer_grid_keeps_the_attenuation_to_second_order():
    """Of a smooth map, against the map on the finer grid."""
    rig, errors = dcspect80(pixels=6, columns=[3], rows=[0]), []

    def blob(grid, sigma):
        return torch.exp(-voxel_centres(grid).square().sum(-1) / (2 * sigma**2))

    for n in (8, 16):
        grid = Grid.centred(n, spacing=96.0 / n)
        fine = grid.refined(2)
        x = blob(fine, 15.0)[None, None]
        expected = Spect(fine, rig, mu=0.03 * blob(fine, 25.0))(x)
        refined = Spect(grid, rig, mu=0.03 * blob(grid, 25.0)).refined(2)(x)
        errors.append(((refined - expected).norm() / expected.norm()).item())
    assert errors[0] / errors[1] == pytest.approx(4, rel=0.1)
    assert errors[1] < 0.004


@pytest.mark.parametrize("mu", [None, 0.01])
def test_bins_match_the_full_operator(mu):
    torch.manual_seed(0)
    grid = Grid.centred(size=(10, 9, 8), spacing=12.0)
    rig = dcspect80(pixels=[6, 5], columns=[0, 5, 11], rows=[0, 1])
    A = Spect(grid, rig, mu=mu)
    x = torch.rand(1, 1, *grid.shape).double()
    y = A(x)
    chosen = torch.rand(A.range_shape) < 0.3
    bins = ray_subset(A, chosen)
    torch.testing.assert_close(bins(x)[0, 0], y[0, 0][chosen])
    values = torch.rand(1, 1, int(chosen.sum())).double()
    whole = torch.zeros_like(y)
    whole[:, :, chosen] = values
    torch.testing.assert_close(bins.T(values), A.T(whole))
    integral = A.pixel_integral()
    if mu is None:
        torch.testing.assert_close(integral.weight, sensitivity(rig, 2.3))
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
def test_voxels_behind_the_pinhole_do_not_contribute(options, tmp_path):
    """The grid is beside the pinhole and extends 64 mm behind it, a map beyond both grids."""
    rig = dcspect80(pixels=40, field=3.0)[[30]]
    if "mu" in options:
        body = long_grid(rig, 96)[0]
        save_volume(tmp_path / "mu.nii.gz", torch.full(body.shape, options["mu"]), body)
        options = {**options, "mu": tmp_path / "mu.nii.gz"}
    (short, point), (long, _) = long_grid(rig, -16), long_grid(rig, 64)
    views = []
    for grid in (short, long):
        A = Spect(grid, rig, 2.3, **options)
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
        (pack, Grid.centred(size=(46, 46, 60), spacing=1.0)),  # pinholes in the box's corners
        (pack, None),
        (lambda: dcspect80(pixels=16), None),
    ],
    ids=[
        "events",
        "events_cardiac",
        "STIR's box",
        "automatic, STIR",
        "automatic, dcspect80",
    ],
)
def test_boxes_beside_pinholes_are_projected_with_blur_and_attenuation(rig, grid):
    cameras = rig()[::9]
    grid = auto_grid(cameras) if grid is None else grid
    A = Spect(grid, cameras, 1.0, mu=0.01, blur=True, intrinsic_mm=4.0)
    x = torch.rand(1, 1, *grid.shape)
    y = A(x)
    z = torch.rand_like(y)
    assert (y * z).double().sum().item() == pytest.approx(
        (x * A.T(z)).double().sum().item(), rel=1e-5
    )
    sharp = Spect(grid, cameras, 1.0, mu=0.01)
    middle = (voxel_centres(grid) - grid.centre).norm(dim=-1) < 12
    ball = middle[None, None].float()
    assert A(ball).sum().item() == pytest.approx(sharp(ball).sum().item(), rel=0.01)
    assert math.isfinite(y.sum().item())


@pytest.mark.parametrize("spacing", [(3.0, 2.0, 2.0), (4.2, 2.0, 2.0)])
def test_rounding_does_not_decide_the_parts_of_long_voxels(spacing):
    """Which a voxel one and a half times as long as wide has the least of."""
    grid = Grid.centred(size=(16, 24, 16), spacing=spacing)
    x = torch.rand(1, 1, *grid.shape, generator=torch.Generator().manual_seed(0))
    exact = Spect(grid, dcspect80(96, columns=[9]), 0.5)(x)
    for nudge in (1e-13, -1e-13):
        affine = grid.affine.clone()
        affine[:3, 0] *= 1 + nudge
        near = Spect(Grid(grid.shape, affine), dcspect80(96, columns=[9]), 0.5)(x)
        torch.testing.assert_close(near / exact.max(), exact / exact.max())
