"""Derivatives of the warps, and torch's requirements for operators."""

from dataclasses import replace

import pytest
import torch
from torch.library import opcheck

from mvrecon.geometry.lattice import grid_lattice, lattice_maps, lifted_maps
from mvrecon.kernels.warps import warp
from mvrecon.methods.learned.view_frames import frusta_lattice
from mvrecon.testing import gradient_gap
from tests.kernels.warps.scenes import (
    DEPTH,
    OTHER,
    RIGS,
    SMALL,
    edges_of,
    generic,
)


def test_gradients_by_values_and_by_homography():
    H = generic().requires_grad_()
    x = torch.randn(1, 2, 2, *SMALL, dtype=torch.float64, requires_grad=True)
    assert gradient_gap(lambda x, H: warp(x, lifted_maps(H), OTHER, "cpu"), x, H) < 1e-6
    y = torch.randn(1, 2, 2, 2, *OTHER, dtype=torch.float64, requires_grad=True)
    back = torch.ops.mvrecon.warp_transpose
    assert gradient_gap(lambda y, H: back(y, lifted_maps(H), list(SMALL)), y, H) < 1e-6
    by_H = [
        torch.autograd.grad(warp(x, lifted_maps(H), OTHER, b).square().sum(), H)[0]
        for b in ("cpu", "reference")
    ]
    assert torch.allclose(*by_H) and by_H[0].abs().max() > 0.1


@pytest.mark.parametrize("kind", ["cone", "parallel"])
def test_gradients_by_the_lift_reach_the_cameras(kind):
    grid, cameras = RIGS[kind]
    edges = edges_of(grid, cameras)
    x = torch.randn(1, len(cameras), 1, DEPTH, *cameras.shape, dtype=torch.float64)
    results = []
    for backend in ("cpu", "reference"):
        rig = replace(cameras, source=cameras.source.clone().requires_grad_())
        maps = lattice_maps(frusta_lattice(rig, grid, edges), grid_lattice(grid))
        results.append(
            torch.autograd.grad(warp(x, maps, grid.shape, backend).square().sum(), rig.source)[0]
        )
    assert torch.allclose(*results) and results[0].abs().max() > 1e-3


def test_second_derivatives_in_values_and_maps_are_exact():
    maps = lifted_maps(generic())
    x = torch.randn(1, 2, 1, *SMALL, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradgradcheck(lambda x: warp(x, maps, OTHER, "cpu").square(), (x,))
    maps.requires_grad_()
    seconds = []
    for backend in ("cpu", "reference"):
        (by_maps,) = torch.autograd.grad(
            warp(x, maps, OTHER, backend).square().sum(), maps, create_graph=True
        )
        seconds.append(torch.autograd.grad(by_maps.sum(), maps)[0])
    assert seconds[1].norm() > 0.1 and torch.allclose(*seconds, rtol=1e-10)


def test_only_requested_derivatives_are_computed(monkeypatch):
    from mvrecon.kernels.warps import cpu as warp_cpu

    monkeypatch.setattr(
        warp_cpu, "warp_vjp", lambda *_: pytest.fail("no gradient in the maps was asked for")
    )
    x = torch.randn(1, 2, 1, *SMALL, requires_grad=True)
    warp(x, lifted_maps(generic()), OTHER, "cpu").sum().backward()
    assert x.grad is not None


def test_torch_accepts_the_operators():
    maps = lifted_maps(generic()).requires_grad_()
    x = torch.randn(2, 2, 1, *SMALL, dtype=torch.float64, requires_grad=True)
    y = torch.randn(2, 2, 2, 1, *OTHER, dtype=torch.float64, requires_grad=True)
    checks = ("test_schema", "test_autograd_registration", "test_faketensor")
    opcheck(torch.ops.mvrecon.warp.default, (x, maps, OTHER), test_utils=checks)
    opcheck(torch.ops.mvrecon.warp_transpose.default, (y, maps, list(SMALL)), test_utils=checks)
    opcheck(
        torch.ops.mvrecon.warp_vjp.default,
        (x.detach(), y.detach(), maps.detach()),
        test_utils=checks,
    )


def test_vmap_over_values_and_over_maps_equals_a_loop():
    maps = torch.stack([lifted_maps(generic()), 1.1 * lifted_maps(generic()) + 0.01])
    x = torch.randn(3, 2, 2, 1, *SMALL, dtype=torch.float64)
    mapped = torch.func.vmap(lambda x: warp(x, maps[0], OTHER, "cpu"), in_dims=1)(x.transpose(0, 1))
    assert torch.equal(mapped, torch.stack([warp(each, maps[0], OTHER, "cpu") for each in x]))
    both = torch.func.vmap(lambda x, maps: warp(x, maps, OTHER, "cpu"))(x[:2], maps)
    assert torch.equal(both[1], warp(x[1], maps[1], OTHER, "cpu"))

    x.requires_grad_()
    one = torch.autograd.grad(
        torch.func.vmap(lambda x: warp(x, maps[0], OTHER, "cpu"))(x).square().sum(), x
    )[0]
    assert torch.allclose(
        one, torch.autograd.grad(warp(x.flatten(0, 1), maps[0], OTHER).square().sum(), x)[0]
    )


def test_a_compiled_graph_contains_the_warp_without_breaks():
    maps = lifted_maps(generic())
    x = torch.randn(1, 2, 1, *SMALL, requires_grad=True)
    compiled = torch.compile(
        lambda x: warp(2 * x, maps, OTHER).sin(), fullgraph=True, backend="aot_eager"
    )
    expected = torch.autograd.grad(warp(2 * x, maps, OTHER).sin().sum(), x)[0]
    assert torch.allclose(torch.autograd.grad(compiled(x).sum(), x)[0], expected)
