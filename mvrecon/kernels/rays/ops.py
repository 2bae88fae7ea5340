"""Projection of volumes [n d h w] along rays to views [n m v u], its transpose, and its derivative
by the rays, lines [m 4 3 k] of `lines.py`. See `reference.project`.

Two codes of an occupancy, see `occupancy.py`. `support`: the volume is the box of a larger one that
is zero outside, and the operators are those of this box. `occupied`: the non-zero part of a volume,
which alone is read; derivatives stay dense.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from mvrecon.geometry.grid import pixel_centres, placed
from mvrecon.kernels.operator import LinearKernel, choose_backend, define, joined
from mvrecon.kernels.rays import reference
from mvrecon.kernels.rays.occupancy import Occupancy, code_size
from mvrecon.kernels.self_test import Errors, error_of

MODULES = {
    "cpu": "mvrecon.kernels.rays.cpu.operators",
    "cuda": "mvrecon.kernels.rays.cuda.operators",
}
#: Suffix of a method's name for several volumes that share rays, with their own kernels.
SEVERAL = " of several volumes"


def _project_in_torch(volume, lines, window, detector, method, support=None, occupied=None):
    if support is not None:
        occupancy = Occupancy.unwrapped(support)
        volume = placed(volume, occupancy.box, occupancy.shape)
    return reference.project(volume, lines, window, detector, method)


RAYS = LinearKernel(
    "project(Tensor volume, Tensor lines, float[] window, SymInt[] detector, str method, "
    "Tensor? support=None, Tensor? occupied=None) -> Tensor",
    "backproject(Tensor views, Tensor lines, float[] window, SymInt[] shape, str method, "
    "Tensor? support=None) -> Tensor",
    "lines_vjp(Tensor volume, Tensor views, Tensor lines, float[] window, str method, "
    "Tensor? support=None, Tensor? occupied=None) -> Tensor",
    MODULES,
    _project_in_torch,
    shapes=(
        lambda volume, lines, window, detector, *_: (volume.shape[0], lines.shape[0], *detector),
        lambda views, lines, window, shape, *_: (views.shape[0], *shape),
    ),
    sizes=(slice(1, 4), slice(2, 4)),
)
project, backproject, lines_vjp = RAYS.forward, RAYS.transpose, RAYS.vjp

occupied = define(
    "occupied(Tensor volume, Tensor lines, float[] window, SymInt[] detector, str method, "
    "str skip) -> Tensor",
    MODULES,
    lambda volume, *_: volume.new_empty(code_size(volume.shape[1:]), dtype=torch.int32),
)
torch.library.register_vmap(occupied.name(), joined(occupied))


def backend_for(tensor: Tensor, backend: str, method: str) -> str:
    """The back end for volumes or views [b c ..] and a method; see `choose_backend`."""
    several = SEVERAL if tensor.shape[0] * tensor.shape[1] > 1 else ""
    return choose_backend(tensor, backend, method.partition(":")[0] + several, self_test)


def self_test(device: str, dtype: torch.dtype, purpose: str) -> Errors:
    """The kernels along rays, including explicit ones, on a tiny scene."""
    method, several, _ = purpose.partition(SEVERAL)
    method = f"{method}:8" if method == "trilinear" else method
    lines, window, detector, shape = tiny_scene(device)
    generator = torch.Generator().manual_seed(0)
    x = torch.rand(5 if several else 1, *shape, generator=generator).to(device, dtype)
    yield from RAYS.self_test(x, lines, window, detector, method)
    from mvrecon.kernels.rays.cuda.operators import scatter

    y = torch.rand(len(x), len(lines), *detector, generator=generator).to(lines)
    expected = reference.backproject(y, lines, window, shape, method)
    y = y.to(torch.promote_types(dtype, torch.float32))
    single, z = one_by_one(lines, detector), y.flatten(1)[..., None, None]
    yield "explicit rays", error_of(scatter(z, single, window, shape, method), expected)


def one_by_one(lines: Float[Tensor, "m 4 3 3"], detector: list[int]) -> Float[Tensor, "r 4 3 1"]:
    """Every ray of some views as a view of one pixel, with constant maps."""
    centre = lines.new_tensor([(detector[1] - 1) / 2, (detector[0] - 1) / 2])
    uv = pixel_centres(detector).to(lines) - centre
    p = torch.cat([uv, torch.ones_like(uv[..., :1])], dim=-1).reshape(-1, 3)
    return torch.einsum("mkxc,rc->mrkx", lines, p).flatten(0, 1)[..., None].contiguous()


def tiny_scene(device: str) -> tuple[Tensor, list[float], list[int], list[int]]:
    """Lines [3 4 3 3], window, detector and shape: three oblique cone beams with different main
    axes.
    """
    maps = []
    for axis in range(3):
        source, beam, u, v = (torch.zeros(3, dtype=torch.float64) for _ in range(4))
        source[axis], source[axis - 1], source[axis - 2] = -19.3, 1.71, -2.37
        beam[axis], beam[axis - 1], beam[axis - 2] = 31.1, -2.13, 3.19
        u[axis - 1], v[axis - 2], u[axis - 2] = 1.13, 1.07, 0.11
        none, direction = torch.zeros_like(u), torch.stack([u, v, beam], dim=-1)
        moment = torch.linalg.cross(source[:, None].expand(3, 3), direction, dim=0)
        maps.append(
            torch.stack([direction, moment, torch.stack([none, none, source], dim=-1), direction])
        )
    return torch.stack(maps).to(device), [0.0, 1.0], [5, 6], [5, 4, 6]
