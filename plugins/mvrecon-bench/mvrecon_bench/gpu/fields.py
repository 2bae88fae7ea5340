"""Operators on a device other than plain rays: footprints behind pinholes, warps, voxel-driven
back-projection, hull; part of `check.py`.
"""

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

import mvrecon as mv
from mvrecon.geometry.lattice import depth_edges, grid_lattice, lattice_maps
from mvrecon.kernels import self_test, voxels, warps
from mvrecon.kernels.warps import warp
from mvrecon.methods.learned.view_frames import frusta_lattice
from mvrecon.operators.visual_hull.hull import visual_hull
from mvrecon.operators.voxel_driven import backproject
from mvrecon_bench.gpu.measuring import Results, throughput
from mvrecon_spect.operators.projector import Spect

#: Self-checks of the kernels before their first use, by purpose.
TESTS = {
    "warp": warps.self_test,
    "voxel_driven": voxels.self_test,
}
#: Linear attenuation in 1/mm before pinholes.
MU = 0.015
BRICK = 4


def agreement(call: Callable[[Tensor], Tensor], x: Tensor, device: str) -> dict[str, Any]:
    """Maximum differences of a value and its gradient from the CPU's, relative to the maximum
    value, and ms of the value on the device.
    """
    results = []
    for place in ("cpu", device):
        leaf = x.to(place).requires_grad_()
        value = call(leaf)
        (gradient,) = torch.autograd.grad(value.square().sum(), leaf)
        results.append((value.detach().cpu(), gradient.cpu()))
    (value, gradient), (other, other_gradient) = results
    with torch.no_grad():
        there = x.to(device)
        ms, _ = throughput(lambda: call(there), device)
    return {
        "value": float((other - value).abs().max() / value.abs().max()),
        "gradient": float((other_gradient - gradient).abs().max() / gradient.abs().max()),
        "ms": ms,
    }


def warped(grid: mv.Grid, rig: mv.Cameras, back: bool) -> Callable[[Tensor], Tensor]:
    """Resample values of the grid to the rig's frusta, or back."""
    frusta = frusta_lattice(rig, grid, depth_edges(rig.depth_range(grid), 16))
    ways = (frusta, grid_lattice(grid)) if back else (grid_lattice(grid), frusta)
    maps, shape = lattice_maps(*ways), ways[1].shape
    return lambda x: warp(x, maps.to(x.device), shape)


def pinholes(grid: mv.Grid, back: bool) -> Callable[[Tensor], Tensor]:
    """Counts with blur and the uniform attenuation `MU`, or their transpose."""
    operators, rig = {}, mv.dcspect80(pixels=16, columns=[0, 7], field=2.0)
    near = mv.Grid.centred(size=grid.size, spacing=128 / max(grid.size))

    def call(x: Tensor) -> Tensor:
        if x.device not in operators:
            operators[x.device] = Spect(near, rig, mu=MU, blur=True).to(x.device)
        A = operators[x.device]
        return A.T(A(x)) if back else A(x)

    return call


def same_hull(grid: mv.Grid, rig: mv.Cameras, views: Tensor, device: str) -> dict[str, Any]:
    """Bricks that differ from the CPU's, and ms on the device."""
    exact, there = visual_hull(views, rig, grid, BRICK), views.to(device)
    differ = exact != visual_hull(there, rig, grid, BRICK).cpu()
    ms, _ = throughput(lambda: visual_hull(there, rig, grid, BRICK), device)
    return {"bricks": exact.numel(), "differ": int(differ.sum()), "ms": ms}


def check_fields(
    results: Results, grid: mv.Grid, rig: mv.Cameras, x: Tensor, views: Tensor, device: str
) -> None:
    """The self-tests of these kernels, and their agreement with the CPU.

    Args:
        results: output.
        grid, rig: of a cone beam.
        x: volumes [b 1 d h w].
        views: views of that rig, [b 1 m v u], with zeros outside the object.
        device: device of the kernels.
    """
    for purpose, tests in TESTS.items() if device.startswith("cuda") else ():
        results.attempt(
            f"self-check {purpose}",
            lambda p=purpose, t=tests: self_test.failure(device, p, torch.float32, t) or "right",
        )
    world, frusta = warped(grid, rig, back=False), warped(grid, rig, back=True)
    lifted = world(x[:, None])[:, 0]
    calls = {
        "pinholes": (pinholes(grid, back=False), x),
        "pinholes, there and back": (pinholes(grid, back=True), x),
        "warp to frusta": (world, x[:, None]),
        "warp to the grid": (frusta, lifted),
        "back-projection": (lambda y: backproject(y, rig, grid, "distance"), views),
    }
    for name, (call, values) in calls.items():
        results.attempt(f"agrees {name}", lambda c=call, v=values: agreement(c, v, device))
    results.attempt("hull", lambda: same_hull(grid, rig, views, device))
