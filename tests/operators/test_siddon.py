"""Siddon's method is exact for constant voxels."""

import itertools

import pytest
import torch

from mvrecon.core.parts import PROJECTORS
from mvrecon.geometry.cameras.camera import Cameras
from mvrecon.geometry.grid import Grid
from mvrecon.testing import gap
from tests.operators.cases import CASES, noise
from tests.operators.rigs import GRID, RIGS


def slow_sum(
    volume: torch.Tensor, grid: Grid, start: torch.Tensor, end: torch.Tensor, ray_extent
) -> float:
    """The integral along one ray: every crossing with every plane, sorted; each piece in the voxel
    of its middle.
    """
    a, b = grid.to_index(start).tolist(), grid.to_index(end).tolist()
    step = [q - p for p, q in zip(a, b, strict=True)]
    sizes = grid.shape[::-1]
    w = sorted((k - 0.5 - a[i]) / step[i] for i in range(3) if step[i] for k in range(sizes[i] + 1))
    w = sorted([min(max(point, ray_extent[0]), ray_extent[1]) for point in w])
    total = 0.0
    for one, two in itertools.pairwise(w):
        x, y, z = (round(a[i] + (one + two) / 2 * step[i]) for i in range(3))
        if two > one and 0 <= x < sizes[0] and 0 <= y < sizes[1] and 0 <= z < sizes[2]:
            total += (two - one) * volume[z, y, x].item()
    return total * (end - start).norm().item()


@pytest.mark.pairwise(kind=RIGS, backend=["reference", "cpu"])
def test_it_equals_the_slow_exact_sum(kind, backend):
    name, rig = RIGS[kind]
    torch.manual_seed(0)
    x = torch.randn(1, 1, *GRID.shape, dtype=torch.float64)
    views = PROJECTORS.build(name, grid=GRID, cameras=rig, method="siddon", backend=backend)(x)[
        0, 0
    ]
    start, end = (points.flatten(0, 2) for points in rig.rays())
    expected = [
        slow_sum(x[0, 0], GRID, a, b, rig.ray_extent) for a, b in zip(start, end, strict=True)
    ]
    assert views.abs().max() > 1
    assert torch.allclose(
        views.flatten(), torch.tensor(expected, dtype=torch.float64), rtol=0, atol=1e-12
    )


@pytest.mark.parametrize("kind", [kind for kind in CASES if kind != "axial"])
def test_it_equals_the_slow_exact_sum_in_single_precision(kind):
    case = CASES[kind]
    x = noise(case)[0][:1].abs()
    rays = zip(*(points.flatten(0, 2) for points in case.rays.rays()), strict=True)
    sums = [slow_sum(x[0, 0], case.grid, start, end, case.rays.ray_extent) for start, end in rays]
    expected, A = torch.tensor(sums, dtype=torch.float64), case.build(method="siddon")
    # neighbours here differ by as much as they are; where a ray passes between them is known to
    # single precision
    assert gap(A(x).flatten(), expected) < 1e-12 and gap(A(x.float()).flatten(), expected) < 2e-6


@pytest.mark.parametrize("backend", ["reference", "cpu"])
def test_no_ray_counts_in_both_of_two_adjacent_boxes(backend):
    """Rays on a face, an edge or a corner belong to exactly one cell."""
    both = Grid.centred((4, 4, 4), 1.0)
    source = torch.tensor([[-9.0, -1.0, -1.0]], dtype=torch.float64)
    u, v = torch.tensor([[0.0, -0.5, 0.0]]), torch.tensor([[0.0, 0.0, -0.5]])
    rig = Cameras(
        source, source + torch.tensor([[18.0, 0, 0]]) - 4 * (u + v), u, v, (9, 9), parallel=True
    )
    rig = Cameras(
        rig.origin - torch.tensor([[18.0, 0, 0]]), rig.origin, u, v, (9, 9), parallel=True
    )
    x = torch.randn(1, 1, 4, 4, 4, dtype=torch.float64)
    total = PROJECTORS.build("radon", grid=both, cameras=rig, method="siddon", backend=backend)(x)
    halves = 0
    for z in (0, 1):
        part = Grid.centred(size=(4, 4, 2), spacing=1.0, centre=(0, 0, 2 * z - 1.0))
        A = PROJECTORS.build("radon", grid=part, cameras=rig, method="siddon", backend=backend)
        halves = halves + A(x[:, :, 2 * z : 2 * z + 2])
    assert total.abs().max() > 1 and torch.allclose(halves, total, rtol=0, atol=1e-14)
