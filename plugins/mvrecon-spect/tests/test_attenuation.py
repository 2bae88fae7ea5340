"""Attenuation before pinholes: path integrals against closed forms, and the transmission that is
cached beside a map.
"""

import gc
import math
import weakref

import pytest
import torch

from mvrecon.geometry.cameras.rigs import Detector, dcspect80
from mvrecon.geometry.grid import Grid
from mvrecon.geometry.rigid import look_at
from mvrecon.operators.selection import view_subset
from mvrecon_spect.operators import footprints
from mvrecon_spect.operators.path_integrals import path_integrals
from mvrecon_spect.operators.projector import Spect

GRID = Grid.centred(size=(12, 10, 9), spacing=12.0)
RIG = dcspect80(pixels=[9, 7], columns=[0, 7, 13], rows=[0, 2], field=2.0)
BLUR = {"blur": True, "intrinsic_mm": 4.0}


def scene(dtype=torch.float32):
    torch.manual_seed(0)
    return 0.03 * torch.rand(GRID.shape, dtype=dtype), torch.rand(1, 2, *GRID.shape, dtype=dtype)


def test_counts_are_weakened_on_their_way_to_the_pinhole_and_not_behind():
    grid = Grid.centred(size=(20, 11, 11), spacing=10.0)
    camera = dcspect80(pixels=9, columns=[0], rows=[0])  # pinhole on the side of +x
    x = torch.zeros(1, 1, *grid.shape, dtype=torch.float64)
    x[..., 5, 5, 9:11] = 1
    near, far = torch.zeros(2, *grid.shape, dtype=torch.float64)
    near[..., 15:], far[..., :5] = 0.02, 0.02
    plain = Spect(grid, camera)(x)
    torch.testing.assert_close(Spect(grid, camera, mu=far)(x), plain, rtol=1e-12, atol=0)
    # the way through the slab, 50 mm over the cosine of a ray that is oblique to it
    start, end = camera.source[0], grid.centre
    cosine = ((start - end) / (start - end).norm())[0].item()
    expected = plain.sum().item() * math.exp(-0.02 * 50 / cosine)
    assert Spect(grid, camera, mu=near)(x).sum().item() == pytest.approx(expected, rel=0.01)


def onto_x(camera):
    """The camera turned so that its pinhole is on the x axis."""
    first = camera.source[0] / camera.source[0].norm()
    second = torch.linalg.cross(torch.tensor([0.0, 0, 1]).double(), first)
    second = second / second.norm()
    turn = torch.stack([first, second, torch.linalg.cross(first, second)])
    return camera.moved(turn, torch.zeros(3, dtype=torch.float64))


@pytest.mark.parametrize("moving", [False, True], ids=["compiled", "reference"])
def test_path_integrals_of_smooth_attenuation_converge_in_second_order(moving):
    """mu = 0.01 (1 + cos(pi x / 120)), from each voxel of the axis to the pinhole."""
    camera, errors = onto_x(dcspect80(pixels=9, columns=[0], rows=[0])), []
    for count in (24, 192):
        grid = Grid.centred(size=(count, 9, 9), spacing=(240.0 / count, 4.0, 4.0))
        x = (torch.arange(count, dtype=torch.float64) + 0.5) * 240 / count - 120
        mu = (0.01 * (1 + (math.pi * x / 120).cos())).expand(grid.shape).contiguous()
        exact = 0.01 * (120 - x - 120 / math.pi * (math.pi * x / 120).sin())
        made = path_integrals(mu.requires_grad_(moving), grid, camera, grid)[0, 4, 4]
        errors.append(((made.detach() - exact).norm() / exact.norm()).item())
    assert errors[0] < 0.0015
    assert math.log(errors[0] / errors[1], 8) > 1.8


@pytest.mark.parametrize(("count", "spacing"), [(66, 5.0), (33, 4.0)])
def test_rounding_does_not_decide_the_steps_of_path_integrals(count, spacing):
    """A whole number of steps of a third of a voxel."""
    source = torch.tensor([[300.0, 0, 0], [0, 300, 0]]).double()
    R, panel = look_at(source, torch.zeros(2, 3)), {"pixels": [16, 16], "pixel_mm": 4.0}
    cameras = Detector.of(panel).carried(source, 1.2 * source, R, extent="behind")
    mu = 0.01 * torch.rand(count, count, count, generator=torch.Generator().manual_seed(0))
    grid, matter = Grid.centred(8, spacing=20.0), Grid.centred(count, spacing=spacing)
    exact = path_integrals(mu, matter, cameras, grid)
    for nudge in (1e-13, -1e-13, 1e-12, -1e-12):
        near = Grid.centred(count, spacing=spacing * (1 + nudge))
        torch.testing.assert_close(path_integrals(mu, near, cameras, grid), exact)


@pytest.fixture
def computed(monkeypatch):
    """Numbers of pinholes for which path integrals were computed."""
    counts = []

    def counted(mu, matter, cameras, grid):
        counts.append(len(cameras))
        return path_integrals(mu, matter, cameras, grid)

    monkeypatch.setattr(footprints, "path_integrals", counted)
    return counts


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("options", [{}, BLUR], ids=["plain", "blur"])
def test_transmission_that_is_cached_changes_no_bit(options, dtype, monkeypatch, computed):
    """Of views, volumes and gradients, for whole rigs and subsets; also under `vmap`."""
    mu, x = scene(dtype)
    every = Spect(GRID, RIG, mu=mu, **options)
    for A in (every, view_subset(every, [4, 1])):
        y = torch.rand(1, 2, *A.range_shape, dtype=dtype)
        with monkeypatch.context() as patch:
            patch.setattr(footprints, "MOST_KEPT", 0)
            expected = A(x), A.T(y)
        for _ in range(2):
            assert torch.equal(A(x), expected[0]) and torch.equal(A.T(y), expected[1])
        assert torch.equal(torch.func.vmap(A)(x[None])[0], expected[0])


def test_transmission_is_computed_once_for_a_map_and_its_pinholes(computed):
    """For all operators of equal geometry: equal ones, subsets, and with or without blur."""
    mu, x = scene()
    A = Spect(GRID, RIG, mu=mu)
    for B in (A, A, Spect(GRID, RIG, mu=mu, **BLUR)):
        B.T(B(x))
    assert computed == [6]
    for views in ([4, 1], [0, 2, 5]):
        view_subset(A, views)(x)
    assert computed == [6]
    view_subset(Spect(GRID, RIG, mu=mu.clone()), [3])(x)
    A.refined(2)(torch.rand(1, 1, *GRID.refined(2).shape))
    Spect(GRID, RIG.moved(torch.eye(3), torch.ones(3)), mu=mu)(x)
    assert computed == [6, 1, 6, 6]
    mu.mul_(0.5)
    A(x)
    assert computed == [6, 1, 6, 6, 6]


def test_cached_transmission_is_freed_with_its_map(computed):
    mu, x = scene()
    A = Spect(GRID, RIG, mu=mu)
    A(x)
    (passed,) = (part for _, part in A.A._passes())
    known = weakref.ref(passed)
    del passed
    gc.collect()
    assert known() is not None
    del A, mu
    gc.collect()
    assert known() is None


def test_no_emission_is_no_counts_and_nan_is_never_skipped():
    mu, x = scene()
    A = Spect(GRID, RIG, mu=mu)
    assert not A(0 * x).any()
    one = torch.zeros_like(x[:, :1])
    one[0, 0, 4, 5, 6] = 1
    seen = A(one) != 0
    assert seen.any()
    assert A(one * torch.nan)[seen].isnan().all()


@pytest.mark.parametrize(
    ("value", "told"),
    [(0.15, "1/cm"), (-0.01, "zero or more"), (torch.nan, "finite")],
)
def test_impossible_attenuation_is_refused(value, told):
    """Attenuation that is negative, not finite or in 1/cm is refused, with the unit."""
    mu, _ = scene()
    mu[3, 3, 3] = value
    with pytest.raises(ValueError, match=told):
        Spect(GRID, RIG, mu=mu)
    with pytest.raises(ValueError, match="sizes"):
        Spect(GRID, RIG, mu=mu[1:])
