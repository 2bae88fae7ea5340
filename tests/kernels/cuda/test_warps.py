"""The warps of CUDA devices, compiled by g++ and run in main memory, against the reference."""

from dataclasses import replace

import pytest
import torch

from mvrecon.geometry.lattice import depth_edges, grid_lattice, lattice_maps, lifted_maps
from mvrecon.kernels.warps import cuda, warp_reference
from mvrecon.methods.learned.view_frames import frusta_lattice
from tests.kernels.cuda.scenes import difference
from tests.kernels.cuda.waits import Waits
from tests.kernels.warps.scenes import OTHER, RIGS, SMALL, generic, lattices
from tests.operators.rigs import CONE, GRID

#: More channels than a thread has, and fewer.
PRECISIONS = [(torch.float64, 3, 1e-11), (torch.float32, 9, 3e-6)]


def compared(maps: torch.Tensor, of, to, dtype: torch.dtype, channels: int) -> dict[str, float]:
    """The differences of the three operators, of numbers stored as `dtype`, to the reference, for
    two items.
    """
    torch.manual_seed(0)
    x = torch.randn(2, len(maps), channels, *of, dtype=dtype)
    moving, wide = maps.clone().requires_grad_(), x.double().requires_grad_()
    values = warp_reference(wide, moving, list(to))
    y = torch.randn(values.shape, dtype=dtype)
    volumes, change = torch.autograd.grad((values * y.double()).sum(), (wide, moving))
    return {
        "warp": difference(cuda.warp(x, maps, list(to)), values),
        "back": difference(cuda.warp_transpose(y, maps, list(of)), volumes),
        "vjp": difference(cuda.warp_vjp(x, y, maps), change),
    }


@pytest.mark.parametrize(("dtype", "channels", "bound"), PRECISIONS)
@pytest.mark.parametrize("kind", [*RIGS, "inside"])
def test_warps_their_transpose_and_derivative_match_the_reference(
    kind, dtype, channels, bound, host
):
    if kind == "inside":  # the plane of a source cuts the grid: voxels beside it have no image
        rig = replace(CONE, source=GRID.centre + 0.02 * (CONE.source - GRID.centre))[:1]
        edges = depth_edges(
            rig.distance[:, None] * torch.tensor([[0.002, 0.4]], dtype=torch.float64), 7
        )
        frusta, world = frusta_lattice(rig, GRID, edges), grid_lattice(GRID)
    else:
        frusta, world = lattices(*RIGS[kind])
    for of, to in ((frusta, world), (world, frusta), (frusta, frusta)):
        errors = compared(lattice_maps(of, to), of.shape, to.shape, dtype, channels)
        if of is to:  # samples on voxels' centres have two derivatives
            del errors["vjp"]
        assert max(errors.values()) < bound, errors


HALVES = [(torch.float16, 9, 3e-6), (torch.bfloat16, 2, 3e-6)]


@pytest.mark.parametrize(("dtype", "channels", "bound"), PRECISIONS + HALVES)
def test_maps_that_have_no_inverse_are_transposed_too(dtype, channels, bound, host):
    """Homographies, maps whose rows grow each in its own way, and one that shows a single plane."""
    maps = lifted_maps(generic(3))
    maps[:, 1, :3, 1] += 0.1 * torch.randn(2, 3, 3, dtype=torch.float64)
    maps[:, 2, 2] = 0
    maps[:, 2, 2, 0, 2] = 0.3
    errors = compared(maps, SMALL, OTHER, dtype, channels)
    assert max(errors.values()) < bound, errors


def test_a_warp_launches_one_kernel_without_synchronisation(host):
    maps = lifted_maps(generic())
    x, y = torch.randn(2, 2, 3, *SMALL), torch.randn(2, 2, 2, 3, *OTHER)
    with Waits() as waits:
        cuda.warp(x, maps, OTHER)
        cuda.warp_transpose(y, maps, SMALL)
        cuda.warp_vjp(x, y, maps)
    assert waits.names == []
    assert host.launches == ["warp", "invert", "warp_back", "warp_vary"]
    assert set(host.streams) == {7} and host.modules == 1


def test_nan_stays_in_its_item_and_empty_warps_launch_no_kernel(host):
    """NaN in one item, channel or map stays there."""
    maps = lifted_maps(generic())
    x = torch.full((2, 2, 2, *SMALL), torch.nan)
    x[1, :, 1] = 1.0
    seen = cuda.warp(x, maps, OTHER)
    assert seen[1, :, :, 1].isfinite().all() and seen[0].isnan().any()
    host.launches.clear()
    assert cuda.warp(x[:0], maps, OTHER).shape == (0, 2, 2, 2, *OTHER) and not host.launches
    assert not cuda.warp_transpose(x[:, :, None][:, :, :0], maps[:, :0], OTHER).any()
