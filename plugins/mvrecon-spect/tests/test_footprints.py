"""Footprints compared with closed forms and with an independent integration over a finite hole."""

import math
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from mvrecon.geometry.cameras.camera import Cameras
from mvrecon.geometry.cameras.rigs import dcspect80
from mvrecon.geometry.grid import Box, Grid, placed, voxel_centres
from mvrecon.operators.selection import view_subset
from mvrecon.testing import gradient_gap
from mvrecon_spect.operators.hole import Hole
from mvrecon_spect.operators.projector import Spect

FWHM = 2 * math.sqrt(2 * math.log(2))
BLUR = {"blur": True, "intrinsic_mm": 2.0}


def pinhole(pixels: int = 32, side: float = 50.0, length: float = 70.0, way: float = 180.0):
    """One pinhole at (way, 0, 0) that looks along -x; its detector of a side in mm behind it."""
    pitch, exact = side / pixels, {"dtype": torch.float64}
    middle = (pixels - 1) / 2 * pitch
    return Cameras(
        torch.tensor([[way, 0, 0]], **exact),
        torch.tensor([[way + length, -middle, middle]], **exact),
        torch.tensor([[0, pitch, 0]], **exact),
        torch.tensor([[0, 0, -pitch]], **exact),
        (pixels, pixels),
        extent="behind",
    )


def turn(axis: int, degrees: float) -> Tensor:
    """Rotation about an axis."""
    angle, matrix = math.radians(degrees), torch.eye(3, dtype=torch.float64)
    i, j = [(1, 2), (2, 0), (0, 1)][axis]
    matrix[i, i] = matrix[j, j] = math.cos(angle)
    matrix[j, i] = math.sin(angle)
    matrix[i, j] = -math.sin(angle)
    return matrix


def rolled(rig: Cameras, degrees: float) -> Cameras:
    """Detectors turned about their centres, in their planes."""
    angle = math.radians(degrees)
    pu, pv = rig.u.norm(dim=1, keepdim=True), rig.v.norm(dim=1, keepdim=True)
    u = math.cos(angle) * rig.u + math.sin(angle) * rig.v * pu / pv
    v = math.cos(angle) * rig.v - math.sin(angle) * rig.u * pv / pu
    rows, columns = rig.shape
    origin = rig.detector_centre - u * (columns - 1) / 2 - v * (rows - 1) / 2
    return replace(rig, origin=origin, u=u, v=v)


def turned(grid: Grid) -> Grid:
    """A grid turned by 20 and 15 degrees about its centre."""
    affine = grid.affine.clone()
    affine[:3, :] = turn(2, 20) @ turn(0, 15) @ affine[:3, :]
    return Grid(grid.shape, affine)


def some(pixels: int, field: float = 1.0) -> Cameras:
    return dcspect80(pixels=pixels, field=field)[[0, 13, 37, 62]]


wide = pinhole(20, 180.0, 89.0, 200.0)
CUBE = Grid.centred(24, spacing=4.0)
#: Rigs and grids, by name.
FIELDS = {
    "64 x 64": (some(64), CUBE),
    "8 x 8": (some(8), CUBE),
    "8 x 8, twice the field": (some(8, 2.0), CUBE),
    "16 x 16, twice the field": (some(16, 2.0), CUBE),
    "rolled by 5 degrees": (rolled(some(32), 5), CUBE),
    "rolled by 45 degrees": (rolled(some(32), 45), CUBE),
    "up to 44 degrees, pixels of 9 mm": (wide, Grid.centred(size=(10, 40, 40), spacing=8.0)),
    "turned by 30 degrees": (
        wide.moved(turn(2, 30), torch.zeros(3)),
        Grid.centred(size=(30, 30, 30), spacing=8.0),
    ),
    "voxels of 2 x 3 x 5 mm": (some(32), Grid.centred(size=(48, 32, 20), spacing=(2, 3, 5))),
    "voxels of 5 x 5 x 1 mm": (some(32), Grid.centred(size=(20, 20, 90), spacing=(5, 5, 1))),
    "long voxels, rolled": (
        rolled(some(32), 45),
        Grid.centred(size=(40, 40, 10), spacing=(1.5, 1.5, 6)),
    ),
    "a turned grid": (some(32), turned(CUBE)),
}


def over_law(camera: Cameras, grid: Grid, options: dict) -> Tensor:
    """A^T 1 of one pinhole over d^2 cos^3 / (16 h^2), of voxels whose views the detector holds."""
    points, hole = voxel_centres(grid).reshape(-1, 3), 2.3
    u, v, z = camera.project(points)[0].unbind(-1)
    m = camera.distance / -z
    cosine = -z / (points - camera.source[0]).norm(dim=-1)
    law = hole**2 * cosine**3 / (16 * z**2) * abs(torch.linalg.det(grid.affine[:3, :3]))
    reach = 1.3 * m / cosine * math.hypot(*grid.spacing) + hole * (1 + m)
    reach = reach + (4 if options else 0)
    inside = torch.ones(len(points), dtype=torch.bool)
    for place, count, step in ((u, camera.shape[1], camera.u), (v, camera.shape[0], camera.v)):
        beside = reach / step.norm()
        inside &= (place > beside - 0.5) & (place < count - 0.5 - beside)
    A = Spect(grid, camera, hole, **options)
    ones = torch.ones(1, 1, *A.range_shape, dtype=torch.float64)
    return A.T(ones).flatten()[inside] / law[inside]


@pytest.mark.parametrize("options", [{}, BLUR], ids=["plain", "blur"])
@pytest.mark.parametrize("name", FIELDS)
def test_each_camera_has_the_sensitivity_of_the_law(name, options):
    """Within 0.3 %."""
    rig, grid = FIELDS[name]
    for camera in rig:
        ratio = over_law(camera, grid, options)
        assert len(ratio) > 10
        assert 0.997 < ratio.min() <= ratio.max() < 1.003


def blob(grid: Grid, sigma: float, centre=(0.0, 0.0, 0.0)) -> Tensor:
    points = voxel_centres(grid) - torch.tensor(centre, dtype=torch.float64)
    return torch.exp(-(points**2).sum(dim=-1) / (2 * sigma**2))[None, None]


def excess_widths(pixels: int, voxel: float, n: int, hole: float, intrinsic: float) -> list[float]:
    """Excess of the variance of a blob's view along u and v over that of blob, voxel, hole,
    resolution and one pixel, in pitch^2 / 12.
    """
    camera, sigma, m = pinhole(pixels), 4.0, 70 / 180
    pitch, grid = 50 / pixels, Grid.centred(n, spacing=voxel)
    at = (torch.arange(n, dtype=torch.float64) - (n - 1) / 2) * voxel
    line = torch.exp(-(at**2) / (2 * sigma**2))
    own = (line * at**2).sum() / line.sum() + voxel**2 / 12
    law = own * m**2 + (hole * (1 + m)) ** 2 / 16 + (intrinsic / FWHM) ** 2 + pitch**2 / 12
    A = Spect(grid, camera, hole, blur=True, intrinsic_mm=intrinsic)
    y, found = A(blob(grid, sigma))[0, 0, 0], []
    for profile in (y.sum(dim=0), y.sum(dim=1)):
        place = torch.arange(pixels, dtype=torch.float64) * pitch
        mean = (profile * place).sum() / profile.sum()
        variance = (profile * (place - mean) ** 2).sum() / profile.sum()
        found.append(((variance - law) / (pitch**2 / 12)).item())
    return found


#: Pixels, voxels in mm and their number.
WIDTHS = [(32, 2.5, 24), (32, 1.0, 50)]


@pytest.mark.parametrize("hole", [2.3, 4.0])
@pytest.mark.parametrize("intrinsic", [0.0, 2.0])
@pytest.mark.parametrize(("pixels", "voxel", "n"), WIDTHS)
def test_the_width_of_a_view_is_that_of_blob_hole_resolution_and_one_pixel(
    pixels, voxel, n, intrinsic, hole
):
    assert all(abs(e) < 0.1 for e in excess_widths(pixels, voxel, n, hole, intrinsic))


def fine_views_of_finite_hole(camera: Cameras, integral, hole: float, parts=4, points=61) -> Tensor:
    """One camera's view on parts of its pixels, by integration over the hole: from the pixel point
    P through the hole's point at R, d counts = cos^4 / (4 pi l^2) dA dP times the integral.

    Args:
        integral: of (start, unit direction), line integrals of the activity from the hole outwards.
    """
    k = torch.arange(points, dtype=torch.float64)
    radius, angle = ((k + 0.5) / points).sqrt() * hole / 2, k * math.pi * (3 - math.sqrt(5))
    fine = camera.refined(parts)
    pixels = fine.rays()[1][0]
    u, v = camera.u[0] / camera.u[0].norm(), camera.v[0] / camera.v[0].norm()
    length, total = camera.distance[0], torch.zeros(fine.shape, dtype=torch.float64)
    for a, b in zip(radius * angle.cos(), radius * angle.sin(), strict=True):
        start = camera.source[0] + a * u + b * v
        ray = start - pixels
        way = ray.norm(dim=-1, keepdim=True)
        total += (length / way[..., 0]) ** 4 * integral(start, ray / way)
    area = math.pi * hole**2 / 4 * torch.linalg.cross(fine.u[0], fine.v[0]).norm()
    return total * area / (4 * math.pi * length**2 * points)


def views_of_finite_hole(camera: Cameras, integral, hole: float, parts=4, points=61) -> Tensor:
    """The same on the pixels."""
    fine = fine_views_of_finite_hole(camera, integral, hole, parts, points)
    return fine.unflatten(0, (-1, parts)).unflatten(2, (-1, parts)).sum(dim=(1, 3))


#: Cameras, and centres of blobs in mm.
BLOBS = {
    "centre": (pinhole(), (0.0, 0.0, 0.0)),
    "aside": (pinhole(), (30.0, 20.0, -25.0)),
    "rolled": (rolled(pinhole(), 45), (0.0, 18.0, 4.0)),
}


def blob_errors(camera: Cameras, centre, hole: float = 2.3) -> tuple[float, float]:
    """Relative error (L2) of the view of a blob, and its total over that of a finite hole."""
    sigma, middle = 4.0, torch.tensor(centre, dtype=torch.float64)

    def integral(start, along):
        to = middle - start
        t = along @ to
        return torch.exp(-(to @ to - t * t) / (2 * sigma**2)) * sigma * math.sqrt(2 * math.pi)

    grid = Grid.centred(26, spacing=1.5, centre=centre)
    expected = views_of_finite_hole(camera, integral, hole)
    y = Spect(grid, camera, hole, blur=True)(blob(grid, sigma, centre))[0, 0, 0]
    error = (y - expected).norm() / expected.norm()
    return error.item(), (y.sum() / expected.sum()).item()


@pytest.mark.parametrize("name", BLOBS)
def test_views_of_a_blob_match_a_finite_hole(name):
    """Within 0.012 in L2, the totals within 0.1 %."""
    error, total = blob_errors(*BLOBS[name])
    assert error < 0.012
    assert total == pytest.approx(1, rel=1e-3)


def body_totals() -> list[float]:
    """Totals of the views of an ellipsoid of activity and water from three sides, over theirs."""
    axes, mu, hole = torch.tensor([34.0, 26.0, 30.0]).double(), 0.015, 2.3
    grid = Grid.centred(30, spacing=2.5)
    fine = voxel_centres(grid.refined(4))
    share = ((fine / axes).norm(dim=-1) < 1).double()
    x = torch.nn.functional.avg_pool3d(share[None, None], 4)

    def integral(start, along):
        a, b = ((along / axes) ** 2).sum(-1), (along / axes**2) @ start
        root = (b * b - a * ((start / axes).norm() ** 2 - 1)).clamp_min(0).sqrt()
        chord = 2 * root / a
        return -torch.expm1(-mu * chord) / mu

    rig = dcspect80(pixels=32, field=2.0)[[0, 13, 41]]
    y = Spect(grid, rig, hole, mu=mu * x[0, 0])(x)[0, 0].sum(dim=(1, 2))
    expected = [views_of_finite_hole(camera, integral, hole, 16, points=1).sum() for camera in rig]
    return [(one / other).item() for one, other in zip(y, expected, strict=True)]


def test_activity_in_its_own_uniform_attenuation_has_the_closed_form():
    """Within 0.4 %."""
    assert body_totals() == pytest.approx([1, 1, 1], abs=4e-3)


def small(dtype=torch.float64):
    torch.manual_seed(0)
    grid = Grid.centred(size=(18, 9, 8), spacing=(7.0, 8.0, 9.0))
    return grid, dcspect80(pixels=[12, 10], columns=[0, 5, 11], rows=[0, 1], field=1.5), torch.rand(
        2, 1, *grid.shape, dtype=dtype
    )  # fmt: skip


@pytest.mark.parametrize("mu", [None, 0.01])
@pytest.mark.parametrize("options", [{}, BLUR, {"acceptance_degrees": 12.0, "collimator_mu": 3.0}])
@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float64, 1e-12), (torch.float32, 2e-6)])
def test_kernels_equal_the_reference_and_have_its_adjoint(options, mu, dtype, tolerance):
    grid, rig, x = small(dtype)
    x[:, :, 2:4] = 0
    mu = mu and mu * torch.rand(grid.shape, dtype=dtype)
    A, B = (Spect(grid, rig, [4.0, 5.0], mu=mu, backend=b, **options) for b in ("cpu", "reference"))
    y, z = A(x), torch.rand(2, 1, *A.range_shape, dtype=dtype) - 0.3
    back = A.T(z)
    assert (y - B(x)).norm() < tolerance * y.norm()
    assert (back - B.T(z)).norm() < tolerance * back.norm()
    products = (y.double() * z).sum().item(), (x.double() * back).sum().item()
    assert products[0] == pytest.approx(products[1], rel=tolerance)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("backend", ["auto", "reference"])
def test_rounding_does_not_decide_whether_a_voxel_is_seen(dtype, backend):
    """Of voxels that touch the pinhole's plane; they are not."""
    side = 7.1
    grid = Grid.centred(6, spacing=side, centre=(180 - 3 * side, 0, 0))
    x = torch.rand(1, 1, *grid.shape, generator=torch.Generator().manual_seed(0)).to(dtype)
    views = [
        Spect(grid, pinhole(24, 200.0, way=180 + moved), blur=True, backend=backend)(x)
        for moved in (-1e-9, -3e-14, 0.0, 3e-14, 1e-9)
    ]
    inner = grid.cropped(Box((0, 0, 0), (6, 6, 5)))  # without the voxels that touch
    views.append(Spect(inner, pinhole(24, 200.0), blur=True, backend=backend)(x[..., :5]))
    for view in views[1:]:
        torch.testing.assert_close(view, views[0], rtol=1e-4, atol=0)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("backend", ["auto", "reference"])
def test_rounding_does_not_decide_whether_a_hole_accepts_a_ray(dtype, backend):
    """Of voxels on the cone of 45 degrees, as those with sides 3, 4, 5; they are seen, as by a
    little wider cone without further voxels. Thin rays through the centres of pixels, too.
    """
    grid = Grid.centred(11, spacing=4.0)
    x = torch.rand(1, 1, *grid.shape, generator=torch.Generator().manual_seed(0)).to(dtype)
    rigs = [pinhole(41, 164.0, 40.0, 40 + moved) for moved in (-1e-9, -3e-14, 0.0, 3e-14, 1e-9)]
    narrower, wider = (
        Spect(grid, rigs[0], acceptance_degrees=most, backend=backend)(x) for most in (44.95, 45.05)
    )
    scale = wider.max().item()
    assert (wider - narrower).max() > 0.01 * scale
    for rig in rigs:
        view = Spect(grid, rig, acceptance_degrees=45.0, backend=backend)(x)
        torch.testing.assert_close(view, wider, rtol=1e-5, atol=1e-5 * scale)
        weights = [Hole(acceptance_degrees=most).weight(rig) for most in (45.0, 45.05)]
        torch.testing.assert_close(*weights)


def test_single_entries_of_forward_and_adjoint_are_the_same_numbers():
    grid, rig, x = small()
    A = Spect(grid, rig, 4.0, mu=0.01, **BLUR)
    voxel, pixel = torch.zeros_like(x[:1]), torch.zeros(1, 1, *A.range_shape, dtype=x.dtype)
    voxel[0, 0, 3, 4, 9] = 1
    view = A(voxel)
    for at in view.flatten().topk(20).indices:
        pixel.zero_().flatten()[at] = 1
        entry = A.T(pixel)[0, 0, 3, 4, 9].item()
        assert entry == pytest.approx(view.flatten()[at].item(), rel=1e-12)


def test_results_do_not_depend_on_the_number_of_threads(monkeypatch):
    from mvrecon.kernels import threads

    monkeypatch.setattr(threads, "LEAST", 1)
    grid, rig, x = small(torch.float32)
    before, results = torch.get_num_threads(), []
    try:
        for count in (1, 2, 5):
            torch.set_num_threads(count)
            A = Spect(grid, rig[[0, 3]], 4.0, **BLUR)
            results.append((A(x), A.T(A(x))))
    finally:
        torch.set_num_threads(before)
    for other in results[1:]:
        assert all(torch.equal(a, b) for a, b in zip(results[0], other, strict=True))


def test_long_voxels_are_split_before_rolled_detectors_only():
    grid = Grid.centred(size=(16, 16, 4), spacing=(1.5, 1.5, 6))
    camera = pinhole()
    assert Spect(grid, camera).A.parts == (1, 1, 1)
    A = Spect(grid, rolled(camera, 45))
    assert A.A.parts == (4, 1, 1)
    x = torch.rand(1, 1, *grid.shape, dtype=torch.float64)
    fine = Grid.centred(size=(16, 16, 16), spacing=1.5)
    expected = Spect(fine, rolled(camera, 45))(x.repeat_interleave(4, dim=2))
    torch.testing.assert_close(A(x), expected)
    y = torch.rand_like(expected)
    assert (A(x) * y).sum().item() == pytest.approx((x * A.T(y)).sum().item(), rel=1e-12)


def test_parts_of_the_operator_equal_the_whole():
    grid, rig, x = small()
    mu = 0.01 * torch.rand(grid.shape, dtype=x.dtype)
    A = Spect(grid, rig, 4.0, mu=mu, **BLUR)
    y, box = A(x), Box((1, 2, 3), (7, 9, 12))
    torch.testing.assert_close(view_subset(A, [4, 1])(x), y[:, :, [4, 1]])
    inside = x[:, :, *box.slices]
    expected = A(placed(inside, box, grid.shape))[:, :, [5, 0]]
    torch.testing.assert_close(A.cropped(box, [5, 0])(inside), expected)
    support = torch.rand(grid.shape) > 0.5
    torch.testing.assert_close(A.with_support(support)(x), A(x * support))


def moved(rig: Cameras, change: Tensor) -> Cameras:
    parts = {n: getattr(rig, n) + change[i] for i, n in enumerate(("source", "origin", "u", "v"))}
    return replace(rig, **parts)


@pytest.mark.parametrize("mu", [None, 0.02])
@pytest.mark.parametrize("options", [{}, BLUR], ids=["plain", "blur"])
def test_gradients_in_poses_are_complete(options, mu):
    """Against central differences of the whole operator, whose widths depend on the pose too."""
    torch.manual_seed(3)
    grid, rig = Grid.centred(size=(7, 6, 5), spacing=9.0), some(14, 2.0)[[0, 2]]
    x = torch.rand(1, 1, *grid.shape, dtype=torch.float64)
    mu = mu and mu * blob(grid, 20.0)[0, 0]
    weights = torch.rand(1, 1, 2, 14, 14, dtype=torch.float64)
    scale = torch.tensor([1.0, 1.0, 0.02, 0.02]).double()[:, None, None]
    direction = torch.randn(4, 2, 3, dtype=torch.float64) * scale

    def loss(change):
        return (Spect(grid, moved(rig, change), 4.0, mu=mu, **options)(x) * weights).sum()

    zero = torch.zeros(4, 2, 3, dtype=torch.float64, requires_grad=True)
    (gradient,) = torch.autograd.grad(loss(zero), zero)
    slope, step = (gradient * direction).sum(), 1e-5
    difference = (loss(step * direction) - loss(-step * direction)) / (2 * step)
    assert slope.item() == pytest.approx(difference.item(), rel=1e-6)


@pytest.mark.parametrize("name", ["source", "origin", "u", "v"])
def test_gradients_in_one_vector_of_the_pose_are_complete(name):
    """Of attenuated counts, by any of the tensors alone; also together with mu. Tried too: blur,
    rectangular holes, voxels of any edges, oblique detectors, pixels that are not square.
    """
    torch.manual_seed(3)
    grid, rig = Grid.centred(size=(4, 6, 5), spacing=9.0), some(14, 2.0)[[0, 2]]
    x, mu = torch.rand(1, 1, *grid.shape).double(), 0.02 * torch.rand(grid.shape).double()

    def counts(vector):
        return Spect(grid, replace(rig, **{name: vector}), 4.0, mu=mu)(x)

    vector = getattr(rig, name).clone().requires_grad_()
    assert gradient_gap(counts, vector, step=1e-6) < 1e-6


def test_gradients_in_attenuation_match_differences():
    grid, rig, x = small()
    mu = 0.01 + 0.01 * torch.rand(grid.shape, dtype=torch.float64)
    weights, direction = torch.rand(2, 1, 6, 12, 10).double(), torch.randn_like(mu)

    def operators(mu):
        A = Spect(grid, rig, 4.0, mu=mu, **BLUR)
        return A(x), A.T(weights)

    moving = mu.clone().requires_grad_()
    losses = [(y * y).sum() for y in operators(moving)]
    for i, loss in enumerate(losses):
        (gradient,) = torch.autograd.grad(loss, moving)
        high, low = ((operators(mu + s * direction)[i] ** 2).sum() for s in (1e-6, -1e-6))
        slope = (gradient * direction).sum().item()
        assert slope == pytest.approx(((high - low) / 2e-6).item(), rel=1e-6)


def test_derivatives_by_volumes_and_views_have_every_order():
    grid, rig, _ = small()
    A = Spect(Grid.centred(4, spacing=9.0), rig[[0, 4]], 4.0, mu=0.01, **BLUR)
    x = torch.rand(1, 1, 4, 4, 4, dtype=torch.float64, requires_grad=True)
    y = torch.rand(1, 1, *A.range_shape, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradgradcheck(lambda x, y: (A(x) * y).sum() ** 2, (x, y), fast_mode=True)
    assert torch.autograd.gradcheck(lambda y: A.T(y), y, fast_mode=True)


@pytest.mark.parametrize(
    ("options", "told"),
    [
        ({"method": "joseph"}, "got pixels of .* voxels; use method 'footprints'"),
        ({"method": "joseph", "blur": True}, "Expected method 'footprints' with blur"),
        ({"method": "joseph", "mu": 0.01}, "Expected method 'footprints' with attenuation"),
        ({"method": "joseph", "mu": "case"}, "Expected method 'footprints' with attenuation"),
        ({"method": "distance_driven"}, "Expected method 'footprints', which integrates.*got 'dis"),
    ],
)
def test_thin_rays_refuse_what_they_do_not_model(options, told):
    with pytest.raises(ValueError, match=told):
        Spect(Grid.centred(10, spacing=4.0), dcspect80(pixels=16), **options)


def test_thin_rays_of_fine_pixels_agree_with_footprints():
    grid, rig = Grid.centred(48, spacing=2.0), some(96)
    x = blob(grid, 12.0)
    y, rays = Spect(grid, rig)(x), Spect(grid, rig, method="joseph")(x)
    assert (y - rays).norm() < 0.005 * rays.norm()
