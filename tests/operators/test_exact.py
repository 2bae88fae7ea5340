"""Integrals known in closed form, and how the error falls with the voxel size."""

import pytest
import torch

from mvrecon.core.parts import PROJECTORS
from mvrecon.data.scenes.solids import Phantom, Solids, voxelise
from mvrecon.geometry.cameras.camera import Cameras
from mvrecon.geometry.cameras.rigs import circular, dome, parallel
from mvrecon.geometry.grid import Grid, voxel_centres

BACKENDS = ("reference", "cpu")
DETECTOR = {"pixels": [24, 24], "pixel_mm": 2.6}


def phantom(kind: str, *semi_axes: float, rotated: bool = True) -> Phantom:
    """One solid of value one, turned at random."""
    torch.manual_seed(5)
    R = (
        torch.linalg.qr(torch.randn(3, 3, dtype=torch.float64))[0]
        if rotated
        else torch.eye(3, dtype=torch.float64)
    )
    R = R * torch.linalg.det(R)
    solid = Solids(
        kind, torch.tensor([[1.0, -2.0, 0.5]]), R[None], torch.tensor([semi_axes]), torch.ones(1)
    )
    return Phantom((solid,))


def box(grid: Grid) -> Phantom:
    """The grid's own box, of value one."""
    half = torch.tensor(
        [n * mm / 2 for n, mm in zip(grid.shape[::-1], grid.spacing, strict=True)],
        dtype=torch.float64,
    )
    eye = torch.eye(3, dtype=torch.float64)[None]
    return Phantom((Solids("box", grid.centre[None], eye, half[None], torch.ones(1)),))


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize(
    "rig",
    [circular(7, 50.0, 90.0, DETECTOR, start_degrees=3.0), dome(7, 40.0, 20.0, 150.0, DETECTOR)],
)
def test_a_box_of_ones_has_chords_as_views(rig, backend):
    grid = Grid.centred(size=(11, 10, 9), spacing=(1.5, 2.0, 1.0))
    expected = box(grid).integrals(*rig.rays(), ray_extent=rig.ray_extent)
    ones = torch.ones(1, 1, *grid.shape, dtype=torch.float64)
    views = PROJECTORS.build("drr", grid=grid, cameras=rig, method="siddon", backend=backend)(ones)[
        0, 0
    ]
    assert torch.allclose(views, expected, rtol=0, atol=1e-11)


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("method", ["joseph", "siddon"])
def test_both_methods_are_exact_from_face_to_face(method, backend):
    """Rays through a plate of ones, from its upper face to its lower."""
    grid = Grid.centred(size=(44, 40, 5), spacing=(1.5, 1.0, 1.2))
    rig = dome(5, 40.0, 20.0, 50.0, {"pixels": [9, 9], "pixel_mm": 0.5})
    expected = box(grid).integrals(*rig.rays(), ray_extent=rig.ray_extent)
    ones = torch.ones(1, 1, *grid.shape, dtype=torch.float64)
    views = PROJECTORS.build("drr", grid=grid, cameras=rig, method=method, backend=backend)(ones)[
        0, 0
    ]
    assert (expected >= 6).all() and torch.allclose(views, expected, rtol=0, atol=1e-11)


@pytest.mark.parametrize("method", ["joseph", "siddon", "trilinear"])
def test_rays_that_miss_are_exactly_zero(method):
    grid = Grid.centred((6, 6, 6), 1.0)
    rig = circular(5, 50.0, 90.0, {"pixels": [20, 20], "pixel_mm": 4.0})
    views = PROJECTORS.build("drr", grid=grid, cameras=rig, method=method)(
        torch.rand(1, 1, 6, 6, 6)
    )[0, 0]
    grown = Grid.centred((8, 8, 8), 1.0) if method != "siddon" else grid
    misses = box(grown).integrals(*rig.rays(), ray_extent=rig.ray_extent) == 0
    assert misses.any() and not misses.all() and not views[misses].any()
    behind = Cameras(rig.source, rig.origin, rig.u, -rig.v, rig.shape, extent="behind")
    assert not PROJECTORS.build("drr", grid=grid, cameras=behind, method=method)(
        torch.rand(1, 1, 6, 6, 6)
    ).any()


def error(method: str, values, expected: torch.Tensor, n: int, name: str, rig: Cameras) -> float:
    grid = Grid.centred((n, n, n), 48.0 / n)
    A = PROJECTORS.build(name, grid=grid, cameras=rig, method=method)
    views = A(values(grid)[None, None].double())[0, 0]
    return ((views - expected).norm() / expected.norm()).item()


@pytest.mark.parametrize(
    ("method", "order"), [("joseph", 0.9), ("siddon", 0.7), ("trilinear", 0.9)]
)
def test_ellipsoids_converge_at_first_order(method, order):
    """Across a sharp edge the voxels themselves are first-order truth."""
    rig = circular(3, 100.0, 160.0, DETECTOR, start_degrees=17.0)
    solid = phantom("ellipsoid", 14.0, 17.0, 11.0)
    expected = solid.integrals(*rig.rays(), ray_extent=rig.ray_extent)
    errors = [
        error(method, lambda grid: voxelise(solid, grid), expected, n, "drr", rig)
        for n in (16, 32, 64)
    ]
    slope = torch.tensor(errors[0] / errors[2]).log2().item() / 2
    assert slope > order and errors[2] < 0.03, f"errors {errors}"


#: Halving the voxel divides a second-order error by more than 3.5.
SECOND = (1.81, 2.3)


@pytest.mark.parametrize(
    ("method", "least", "most"), [("joseph", *SECOND), ("trilinear", *SECOND), ("siddon", 0.8, 1.9)]
)
@pytest.mark.parametrize("name", ["drr", "radon"])
def test_a_smooth_blob_converges_at_the_method_order(name, method, least, most):
    cone = circular(3, 100.0, 160.0, DETECTOR, start_degrees=17.0)
    rig = cone if name == "drr" else parallel(3, DETECTOR, 200.0, start_degrees=17.0)
    start, end = rig.rays()
    along = torch.nn.functional.normalize(end - start, dim=-1)
    off = start - (start * along).sum(-1, keepdim=True) * along
    sigma = 6.0
    expected = sigma * (2 * torch.pi) ** 0.5 * torch.exp(-off.square().sum(-1) / (2 * sigma**2))

    def blob(grid: Grid) -> torch.Tensor:
        return torch.exp(-voxel_centres(grid).square().sum(-1) / (2 * sigma**2))

    errors = [error(method, blob, expected, n, name, rig) for n in (16, 32, 64)]
    slope = torch.tensor(errors[0] / errors[2]).log2().item() / 2
    assert least < slope < most, f"order {slope}, errors {errors}"


@pytest.mark.parametrize("backend", BACKENDS)
def test_a_slice_is_the_radon_transform(backend):
    """One slice of one millimetre under one detector row: the chords of a disc."""
    radius, n = 20.0, 128
    grid = Grid.centred(size=(n, n, 1), spacing=(48.0 / n, 48.0 / n, 1.0))
    rig = parallel(5, {"pixels": [1, 40], "pixel_mm": [1.0, 1.1]}, 100.0, start_degrees=10.0)
    solid = Solids(
        "cylinder",
        torch.zeros(1, 3),
        torch.eye(3)[None].double(),
        torch.tensor([[radius, radius, 1.0]]),
        torch.ones(1),
    )
    disc = voxelise(Phantom((solid,)), grid)
    u = (torch.arange(40, dtype=torch.float64) - 19.5) * 1.1
    expected = 2 * (radius**2 - u**2).clamp_min(0).sqrt()
    for method in ("joseph", "siddon"):
        A = PROJECTORS.build("radon", grid=grid, cameras=rig, method=method, backend=backend)
        views = A(disc[None, None].double())[0, 0, :, 0]
        assert ((views - expected).norm(dim=-1) / expected.norm()).max() < 0.01
