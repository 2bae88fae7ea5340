"""Distance-driven pixels: areas of footprints by independent numpy code, the mean over a pixel,
partitions of unity, and the choice of the method.
"""

import math

import numpy as np
import pytest
import torch

from mvrecon.geometry.cameras.camera import ExplicitRays
from mvrecon.geometry.cameras.rigs import dcspect80, parallel
from mvrecon.geometry.grid import Grid, voxel_centres
from mvrecon_spect.attenuated import AttenuatedTransform
from mvrecon_spect.projector import Spect
from mvrecon_spect.rays import along_voxels

AREAS = {"method": "distance_driven"}


def facing(pixels, pixel_mm):
    """A parallel beam along y whose columns run along x and rows along z."""
    detector = {"pixels": list(pixels), "pixel_mm": list(pixel_mm)}
    return parallel(n_views=1, detector=detector)


def covered(edges, count, spacing):
    """The part of each interval between edges that each of `count` voxels about zero covers."""
    faces = (np.arange(count + 1) - count / 2) * spacing
    low = np.maximum(edges[:-1, None], faces[None, :-1])
    high = np.minimum(edges[1:, None], faces[None, 1:])
    return np.maximum(high - low, 0) / np.diff(edges)[:, None]


@pytest.mark.parametrize("pixel_mm", [(1.3, 0.9), (3.0, 3.0), (7.1, 11.3)])
def test_weights_of_a_parallel_beam_are_the_overlaps_of_pixels_and_voxels(pixel_mm):
    grid, rig = Grid.centred(size=(7, 5, 6), spacing=(3.0, 4.0, 2.5)), facing((8, 9), pixel_mm)
    x = torch.rand(grid.shape, generator=torch.Generator().manual_seed(0)).double()
    y = AttenuatedTransform(grid, rig, 0 * x, **AREAS)(x[None, None])[0, 0, 0]
    beam = rig.origin[0] - rig.source[0]
    axis = int(beam.abs().argmax())  # of x or y
    along = 0 if axis == 1 else 1
    u, v = rig.u[0, along].item(), rig.v[0, 2].item()
    first_u = rig.origin[0, along].item() - u / 2
    first_v = rig.origin[0, 2].item() - v / 2
    columns = first_u + u * np.arange(10)
    rows = first_v + v * np.arange(9)
    sums = x.sum(dim=2 - axis).numpy() * grid.spacing[axis]  # [z, the other axis]
    across = covered(np.sort(columns), sums.shape[1], grid.spacing[along])
    down = covered(np.sort(rows), sums.shape[0], grid.spacing[2])
    expected = down[:: 1 if v > 0 else -1] @ sums @ across[:: 1 if u > 0 else -1].T
    np.testing.assert_allclose(y.numpy(), expected, rtol=1e-12, atol=1e-12)


def rolled(rig, degrees):
    """The same pinholes with their detectors rotated about the axis."""
    turn = math.radians(degrees)
    cosine, sine = math.cos(turn), math.sin(turn)
    u, v = cosine * rig.u + sine * rig.v, cosine * rig.v - sine * rig.u
    middle = rig.detector_centre
    rows, columns = rig.shape
    origin = middle - (columns - 1) / 2 * u - (rows - 1) / 2 * v
    return type(rig)(rig.source, origin, u, v, rig.shape, extent=rig.extent)


@pytest.mark.parametrize("degrees", [0, 90])
def test_footprints_of_adjacent_pixels_adjoin(degrees):
    """The sensitivity of a camera to voxels is that of the formula, with rays 9 mm apart."""
    rig = rolled(dcspect80(pixels=24, columns=[3], rows=[1]), degrees)
    grid = Grid.centred(20, spacing=4.0)
    points = voxel_centres(grid)
    z = rig.project(points)[0][..., 2]
    away = (points - rig.source[0]).norm(dim=-1)
    law = 64 * 2.3**2 * (-z / away) ** 3 / (16 * z**2)
    ones, shares = torch.ones(1, 1, 1, *rig.shape).double(), {}
    for rays, options in ((0, AREAS), (1, {"rays_per_pixel": 1}), (3, {"rays_per_pixel": 3})):
        shares[rays] = (Spect(grid, rig, **options).T(ones)[0, 0] / law)[2:-2, 2:-2, 2:-2]
    assert shares[0].mean().item() == pytest.approx(1, abs=1e-3)
    assert shares[0].std().item() < 0.015 < shares[3].std().item()
    assert (shares[0] - 1).abs().max().item() < 0.04 < (shares[1] - 1).abs().max().item() / 50


@pytest.mark.parametrize(("degrees", "adjoin"), [(0, True), (4, True), (8, False), (45, False)])
def test_oblique_pixels_are_not_distance_driven_without_a_warning(degrees, adjoin, recwarn):
    rig, grid = rolled(dcspect80(pixels=24)[::20], degrees), Grid.centred(20, spacing=4.0)
    assert along_voxels(rig, grid) == adjoin
    assert (Spect(grid, rig, blur=True).A.method == "distance_driven") == adjoin
    Spect(grid, rig, **AREAS)
    assert bool([one for one in recwarn if "oblique" in str(one.message)]) != adjoin


def test_wide_pixels_are_more_accurate_than_with_as_many_rays():
    """Blobs behind pixels three voxels wide, against closed-form integrals along 8 x 8 rays."""
    rig, grid = dcspect80(pixels=24, columns=[2, 12], rows=[0, 1]), Grid.centred(40, spacing=3.0)
    centres = torch.tensor([[20.0, -10, 8], [-25, 5, -12], [0, 22, 3]]).double()
    wide = 8.0
    x = sum(torch.exp(-(voxel_centres(grid) - c).square().sum(-1) / (2 * wide**2)) for c in centres)
    start, end = rig.refined(8).rays()
    along = torch.nn.functional.normalize(end - start, dim=-1)
    exact = torch.zeros(along.shape[:-1]).double()
    for centre in centres:
        offset = centre - start
        squared = offset.square().sum(-1) - (offset * along).sum(-1).square()
        exact += math.sqrt(2 * math.pi) * wide * torch.exp(-squared / (2 * wide**2))
    weight = Spect(grid, rig.refined(8), rays_per_pixel=1).pixels
    exact = 64 * torch.nn.functional.avg_pool2d(exact * weight, 8)
    errors = {}
    for name, options in {
        "areas": AREAS,
        "rays": {"rays_per_pixel": 5},
        "ray": {"rays_per_pixel": 1},
    }.items():
        y = Spect(grid, rig, **options)(x[None, None])[0, 0]
        errors[name] = ((y - exact).norm() / exact.norm()).item()
    assert errors["areas"] < 0.01 and errors["areas"] < errors["rays"] < errors["ray"]


@pytest.mark.parametrize(("dtype", "bound"), [(torch.float64, 1e-12), (torch.float32, 2e-6)])
def test_skipping_and_kept_transmission_change_no_bit(dtype, bound):
    grid, rig = Grid.centred(size=(14, 11, 9), spacing=7.0), dcspect80(pixels=10)[::9]
    mu = 0.02 * torch.rand(grid.shape, dtype=dtype)
    x = torch.zeros(1, 1, *grid.shape, dtype=dtype)
    x[..., 3:6, 2:7, 5:11] = torch.rand(3, 5, 6)
    A, dense = (AttenuatedTransform(grid, rig, mu, skip=how, **AREAS) for how in ("auto", "off"))
    views = A(x)
    assert torch.equal(views, dense(x)) and torch.equal(views, A(x)) and torch.equal(views, A(x))
    volume = A.T(views)
    assert torch.equal(volume, A.T(views))
    oracle = AttenuatedTransform(grid, rig, mu, backend="reference", **AREAS)
    for one, other in ((views, oracle(x)), (volume, oracle.T(views))):
        assert (one - other).norm() <= bound * other.norm()


def test_poses_have_gradients():
    grid, rig = Grid.centred(6, spacing=20.0), dcspect80(pixels=[2, 3], columns=[4], rows=[1])
    x = torch.rand(1, 1, *grid.shape, generator=torch.Generator().manual_seed(0)).double()

    def views(source):
        some = type(rig)(source, rig.origin, rig.u, rig.v, rig.shape, extent="behind")
        return AttenuatedTransform(grid, some, torch.zeros(grid.shape), **AREAS)(x)

    assert torch.autograd.gradcheck(views, rig.source.clone().requires_grad_(), atol=1e-4)


@pytest.mark.parametrize(
    ("options", "method", "rays"),
    [
        ({"pixels": 64}, "joseph", 1),
        ({"pixels": 32}, "distance_driven", 1),
        ({"pixels": 32, "method": "joseph"}, "joseph", 2),
        ({"pixels": 32, "rays_per_pixel": 4}, "joseph", 4),
        ({"pixels": 32, "rays_per_pixel": 1, "method": "siddon"}, "siddon", 1),
        ({"pixels": 64, "method": "distance_driven"}, "distance_driven", 1),
    ],
)
def test_wide_pixels_are_distance_driven_by_default(options, method, rays):
    """Rays are 3.5 or 7 mm apart at the centre of a grid of 8 mm."""
    rig, options = dcspect80(pixels=options["pixels"], columns=[3]), {**options}
    del options["pixels"]
    A = Spect(Grid.centred(12, spacing=8.0), rig, **options, blur=True)
    assert (A.A.method, A.A.rays_per_pixel) == (method, rays)


def test_areas_need_cameras_and_no_other_rays():
    grid, rig = Grid.centred(8, spacing=12.0), dcspect80(pixels=4)
    with pytest.raises(ValueError, match="one ray per pixel"):
        Spect(grid, rig, rays_per_pixel=2, **AREAS)
    start, end = rig.rays()
    with pytest.raises(ValueError, match="needs cameras"):
        AttenuatedTransform(grid, ExplicitRays(start, end), torch.zeros(grid.shape), **AREAS)
