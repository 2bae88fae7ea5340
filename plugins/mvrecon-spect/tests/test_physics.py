"""Attenuation, blur and the edge of pinholes: closed forms, matched adjoints, input checks."""

import math
from dataclasses import replace

import pytest
import torch

from mvrecon.data.volume_files import save_volume
from mvrecon.geometry.cameras.rigs import dcspect80
from mvrecon.geometry.grid import Box, Grid, placed
from mvrecon.operators.selection import view_subset
from mvrecon_spect.methods.bsrem import bsrem
from mvrecon_spect.methods.kem import kem
from mvrecon_spect.methods.tv_map import tv_map
from mvrecon_spect.operators.hole import Hole
from mvrecon_spect.operators.multiplexed import Multiplexed
from mvrecon_spect.operators.projector import Spect

BLUR = {"blur": True, "intrinsic_mm": 4.0}


def scene(dtype=torch.float64):
    torch.manual_seed(0)
    grid = Grid.centred(size=(10, 9, 8), spacing=12.0)
    return (
        grid,
        dcspect80(pixels=[12, 10], columns=[0, 5, 11], rows=[0, 1]),
        0.03 * torch.rand(grid.shape, dtype=dtype),
    )


def width(profile):
    """Full width at half of the maximum, in samples, linear between them."""
    half = profile.max().item() / 2
    above = (profile > half).nonzero().flatten()
    first, last = int(above[0]), int(above[-1])
    before, low, high, after = (profile[i].item() for i in (first - 1, first, last, last + 1))
    return last - first + (low - half) / (low - before) + (high - half) / (high - after)


@pytest.mark.parametrize("module", [0, 10, 25])
def test_a_point_at_the_heart_has_the_width_of_the_image_of_the_hole(module):
    """Root mean square of a disc, D / 4, and the FWHM of its line profile, sqrt(3) / 2 D."""
    camera = dcspect80(pixels=201)[[module]]
    grid = Grid.centred(size=(3, 3, 3), spacing=0.3)
    x = torch.zeros(1, 1, 3, 3, 3, dtype=torch.float64)
    x[..., 1, 1, 1] = 1
    image = Spect(grid, camera, 2.3, blur=True)(x)[0, 0, 0]
    z, length = camera.source.norm().item(), camera.distance.item()
    at_object = 50 / 201 * z / length
    wanted = 2.3 * (z + length) / length
    for profile in (image.sum(dim=0), image.sum(dim=1)):
        place = torch.arange(201).double()
        mean = (profile * place).sum() / profile.sum()
        spread = ((profile * (place - mean) ** 2).sum() / profile.sum() - 1 / 12).sqrt()
        assert 4 * spread.item() * at_object == pytest.approx(wanted, rel=0.003)
        assert width(profile) * at_object == pytest.approx(math.sqrt(3) / 2 * wanted, rel=0.04)


def test_the_detector_adds_its_own_width_in_quadrature():
    camera = dcspect80(pixels=151)[[0]]
    grid = Grid.centred(size=(3, 3, 3), spacing=0.3)
    x = torch.zeros(1, 1, 3, 3, 3, dtype=torch.float64)
    x[..., 1, 1, 1] = 1
    place = torch.arange(151, dtype=torch.float64) - 75

    def variance(**options):
        image = Spect(grid, camera, 2.3, **options)(x)[0, 0, 0].sum(dim=0)
        return ((image * place**2).sum() / image.sum()).item() * (50 / 151) ** 2

    own = 4.0**2 / (8 * math.log(2))
    added = variance(blur=True, intrinsic_mm=4.0) - variance(blur=True)
    assert added == pytest.approx(own, rel=0.03)


def test_blur_conserves_counts_inside_the_field_of_view():
    grid = Grid.centred(size=(6, 6, 6), spacing=4.0)
    cameras = dcspect80(pixels=24, columns=[0, 9], rows=[1])
    x = torch.rand(1, 1, 6, 6, 6, dtype=torch.float64)
    sharp, soft = Spect(grid, cameras)(x), Spect(grid, cameras, **BLUR)(x)
    torch.testing.assert_close(soft.sum(dim=(-2, -1)), sharp.sum(dim=(-2, -1)), rtol=5e-3, atol=0)


@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float64, 1e-12), (torch.float32, 1e-5)])
def test_blurred_and_attenuated_adjoints_match_each_other_and_the_reference(dtype, tolerance):
    grid, cameras, mu = scene(dtype)
    x = torch.rand(1, 2, *grid.shape, dtype=dtype)
    results = []
    for backend in ("cpu", "reference"):
        m = mu.clone().requires_grad_()
        A = Spect(grid, cameras, 6.0, m, **BLUR, backend=backend)
        y = A(x)
        z = torch.linspace(-1, 2, y.numel(), dtype=dtype).reshape(y.shape)
        back = A.T(z)
        products = (y.double() * z).sum().item(), (x.double() * back).sum().item()
        assert products[0] == pytest.approx(products[1], rel=tolerance)
        results.append((y, back, torch.autograd.grad((y * z).sum(), m)[0]))
    for one, other in zip(*results, strict=True):
        assert (one - other).norm() <= tolerance * other.norm()


def test_subsets_crops_and_supports_match_the_full_operator():
    from mvrecon.geometry.grid import Box

    grid, cameras, mu = scene()
    x = torch.rand(1, 1, *grid.shape, dtype=torch.float64)
    for options in (BLUR, {}):
        A = Spect(grid, cameras, 6.0, mu, **options)
        y = A(x)
        torch.testing.assert_close(view_subset(A, [4, 1])(x), y[:, :, [4, 1]])
        support = torch.rand(grid.shape) > 0.5
        torch.testing.assert_close(A.with_support(support)(x), A(x * support))
        box = Box((1, 2, 3), (8, 9, 10))
        inside = torch.zeros_like(x)
        inside[:, :, *box.slices] = x[:, :, *box.slices]
        part = A.cropped(box, [5, 0])(x[:, :, *box.slices])
        torch.testing.assert_close(part, A(inside)[:, :, [5, 0]])


def test_zero_attenuation_changes_no_bit():
    grid, cameras, _ = scene()
    x = torch.rand(1, 1, *grid.shape)
    assert torch.equal(Spect(grid, cameras, mu=0.0, **BLUR)(x), Spect(grid, cameras, **BLUR)(x))


def test_penetration_of_the_rim_widens_the_hole():
    mu, tangent = 2.692, math.tan(math.radians(45))
    edge = {"collimator_mu": mu, "opening_degrees": 90.0}
    assert Hole(2.3, **edge).effective_mm[0] == pytest.approx((2.3 * (2.3 + 2 / mu)) ** 0.5)
    paix = (2.3**2 + 2 * 2.3 / mu * tangent + 2 / mu**2) ** 0.5
    assert Hole(2.3, **edge, sensitivity="paix").effective_mm[0] == pytest.approx(paix)
    assert Hole(2.3, **edge).blurring_mm[0] == pytest.approx(2.3 + math.log(2) / mu)
    assert Hole(2.3).effective_mm == Hole(2.3).blurring_mm == (2.3, 2.3)


def test_sensitivity_follows_the_area_of_the_hole_and_its_acceptance_cone():
    _, cameras, _ = scene()
    square = Hole([2.0, 3.0]).weight(cameras)
    round_ = Hole(2.0).weight(cameras)
    torch.testing.assert_close(square / round_, torch.full_like(square, 6 / math.pi))
    cone = Hole(2.0, acceptance_degrees=10.0).weight(cameras)
    start, end = cameras.rays()
    cosine = cameras.distance[:, None, None] / (end - start).norm(dim=-1)
    accepted = cosine >= math.cos(math.radians(10))
    assert 0 < int(accepted.sum()) < accepted.numel()
    assert torch.equal(cone, round_ * accepted)


def two_holes(rig):
    """Two pinholes, 16 mm apart along u, before each detector of a rig."""
    twice = rig[[view for view in range(len(rig)) for _ in range(2)]]
    side = twice.source.new_tensor([-8.0, 8.0]).repeat(len(rig))[:, None]
    return replace(twice, source=twice.source + side * twice.u / twice.u.norm(dim=1, keepdim=True))


def test_images_of_several_holes_on_one_detector_add_up():
    grid, cameras, mu = scene()
    pinholes = Spect(grid, two_holes(cameras[:3]), 2.3, mu)
    A = Multiplexed(pinholes, 2)
    x = torch.rand(1, 1, *grid.shape, dtype=torch.float64)
    y = pinholes(x)
    torch.testing.assert_close(A(x), y[:, :, 0::2] + y[:, :, 1::2])
    z = torch.rand_like(A(x))
    assert (A(x) * z).sum().item() == pytest.approx((x * A.T(z)).sum().item(), rel=1e-12)
    torch.testing.assert_close(view_subset(A, [2])(x), A(x)[:, :, [2]])


def test_pinholes_that_are_not_grouped_by_detector_are_refused():
    """Neither one of each detector after the other, nor those of different detectors."""
    grid, cameras, _ = scene()
    rig = two_holes(cameras[:3])
    for wrong in (rig[[0, 2, 4, 1, 3, 5]], cameras):
        with pytest.raises(ValueError, match="2 consecutive pinholes with one detector"):
            Multiplexed(Spect(grid, wrong, 2.3), 2)


@pytest.mark.parametrize("method", [bsrem, tv_map, kem])
def test_one_hole_on_each_detector_is_reconstructed_as_without_a_sum(method):
    """Its voxels are as wide, and its attenuation the same. Also tried: corrected and scaled sums,
    subsets of views and of bins, several operators in one likelihood.
    """
    _, cameras, mu = scene(torch.float32)
    grid = Grid.centred(size=(10, 9, 8), spacing=(12.0, 10.0, 7.0))
    A = Spect(grid, cameras, 6.0, mu)
    counts = torch.poisson(A(100 * torch.rand(1, 1, *grid.shape)))
    torch.testing.assert_close(method(Multiplexed(A, 1), counts, 3), method(A, counts, 3))


def test_a_volume_in_a_file_is_resampled_to_the_grid(tmp_path):
    from mvrecon.data.nifti import save_nifti

    grid, cameras, _ = scene()
    save_nifti(tmp_path / "mu.nii.gz", torch.full((16, 18, 20), 0.015), grid.refined(2))
    A = Spect(grid, cameras, mu=str(tmp_path / "mu.nii.gz"))
    torch.testing.assert_close(A.mu_map(), torch.full(grid.shape, 0.015))


@pytest.mark.parametrize("blur", [{}, {"blur": True, "intrinsic_mm": 9.0}])
def test_matter_beyond_the_grid_attenuates_as_on_a_larger_grid(tmp_path, blur):
    torch.manual_seed(1)
    whole, inner = Grid.centred(size=(14, 13, 12), spacing=12.0), Box((3, 2, 4), (9, 10, 11))
    cameras = dcspect80(pixels=[12, 10], columns=[0, 5, 11], rows=[0, 1])
    mu = 0.01 + 0.01 * torch.rand(whole.shape)
    save_volume(tmp_path / "mu.nii.gz", mu, whole)
    x = torch.rand(1, 1, *inner.shape)
    A = Spect(whole.cropped(inner), cameras, mu=tmp_path / "mu.nii.gz", **blur)
    expected = Spect(whole, cameras, mu=mu, **blur)(placed(x, inner, whole.shape))
    cut = Spect(whole.cropped(inner), cameras, mu=mu[inner.slices], **blur)(x)
    torch.testing.assert_close(A(x), expected, rtol=1e-4, atol=1e-6 * expected.max().item())
    assert (cut - expected).norm() > 0.5 * expected.norm()
    y = torch.rand_like(expected)
    assert (A(x) * y).sum().item() == pytest.approx((x * A.T(y)).sum().item(), rel=1e-5)
    torch.testing.assert_close(view_subset(A, [1, 4])(x), A(x)[:, :, [1, 4]])


def test_a_map_within_the_grid_has_no_part_beyond_it(tmp_path):
    grid, cameras, _ = scene()
    for map_grid in (grid, grid.refined(2), grid.cropped(Box((1, 1, 1), (6, 6, 6)))):
        save_volume(tmp_path / "mu.nii.gz", torch.full(map_grid.shape, 0.015), map_grid)
        A = Spect(grid, cameras, mu=tmp_path / "mu.nii.gz").A
        assert A.matter is grid


@pytest.mark.parametrize(
    ("options", "told"),
    [
        ({"mu": 0.15}, "1/cm"),
        ({"mu": -0.01}, "zero or more"),
        ({"diameter_mm": -1.0}, "positive mm"),
        ({"diameter_mm": [1.0, 2.0, 3.0]}, "two sides"),
        ({"collimator_mu": 0.0}, "attenuation"),
        ({"opening_degrees": 180.0}, "opening angle"),
        ({"acceptance_degrees": 100.0}, "acceptance"),
        ({"sensitivity": "none"}, "law"),
        ({"intrinsic_mm": -1.0}, "FWHM"),
    ],
)
def test_impossible_options_are_refused(options, told):
    """Options of a pinhole, its blur and attenuation that cannot be are refused."""
    grid, cameras, _ = scene()
    with pytest.raises(ValueError, match=told):
        Spect(grid, cameras, **options)


def test_a_pinhole_inside_the_object_is_refused():
    """A pinhole inside the grid of the activity is refused."""
    with pytest.raises(ValueError, match="pinhole 0 in it"):
        Spect(Grid.centred(10, spacing=80.0), dcspect80(pixels=4))


@pytest.mark.parametrize(
    ("shares", "first"), [((0.9, 1.5, 0.5), 2), ((0.7, 0.9, 0.5), 0), ((0.99, 0.81, 0.79), 2)]
)
def test_the_refused_pinhole_is_named(shares, first):
    """Not one near the grid's surface, which is accepted. Shares: of the way from the grid's centre
    to the ellipsoid inscribed in its box.
    """
    grid, rig = Grid.centred(10, spacing=8.0), dcspect80(pixels=4)[[0, 20, 40]]
    reach = rig.source.new_tensor(shares)[:, None] * 40.0 / rig.source.norm(dim=1, keepdim=True)
    moved = replace(rig, source=reach * rig.source, origin=rig.origin + (reach - 1) * rig.source)
    with pytest.raises(ValueError, match=f"got pinhole {first} in it"):
        Spect(grid, moved)
