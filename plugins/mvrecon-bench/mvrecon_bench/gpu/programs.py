"""Operators to time: mvrecon's, and those of other programs (nanodrr, DiffDRR, flashdrr, ASTRA) if
installed.

Volumes are [n d h w], views [n m v u]. Directions that a program does not support are None.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

import mvrecon as mv
from mvrecon.geometry.cameras.camera import VECTORS

Call = Callable[[Tensor], Tensor]


@dataclass
class Program:
    """Operators of a program.

    Args:
        forward: volumes to views.
        adjoint: views to volumes.
        pose: volumes and views to the gradients with respect to the cameras.
    """

    forward: Call | None
    adjoint: Call | None = None
    pose: Callable[[Tensor, Tensor], Any] | None = None


def ours(grid: mv.Grid, rig: mv.Cameras, device: str, **options: Any) -> Program:
    """mvrecon's own projector."""
    A = mv.Drr(grid, rig, **options).to(device)
    leaves = {name: getattr(rig, name).clone().requires_grad_() for name in VECTORS}
    moving = mv.Drr(grid, replace(rig, **leaves), **options).to(device)

    def pose(x: Tensor, y: Tensor) -> Any:
        return torch.autograd.grad(moving(x[:, None]), list(leaves.values()), y[:, None])

    return Program(lambda x: A(x[:, None])[:, 0], lambda y: A.T(y[:, None])[:, 0], pose)


def scattered(grid: mv.Grid, rig: mv.Cameras, device: str) -> Program:
    """Our ray-driven adjoint with atomic additions."""
    from mvrecon.kernels.rays.cuda import operators as cuda

    A = mv.Drr(grid, rig).to(device)
    rays = A.fixed_lines, A.ray_extent, grid.shape, "joseph"
    return Program(None, lambda y: cuda.scatter(y, *rays))


def diffdrr(grid: mv.Grid, rig: mv.Cameras, device: str, method: str) -> Program:
    """DiffDRR through mvrecon-peers."""
    from mvrecon_peers.diffdrr import Diffdrr

    A = Diffdrr(grid, rig, method).to(device)
    return Program(lambda x: A(x[:, None])[:, 0])


class NanodrrModule:
    """nanodrr's renderer, called as in its own module, with the correct detector width."""

    def __init__(self, grid: mv.Grid, rig: mv.Cameras, device: str, samples: int | None = None):
        from nanodrr.drr import backends

        from mvrecon_peers.frame import framed, near

        box, self.rig = framed(grid, rig)
        ends = near(box, *self.rig.rays())
        self.source, self.target = (p.flatten(1, 2).float().to(device) for p in ends)
        self.samples = samples or math.ceil(math.hypot(*grid.shape))
        self.backend, self.shape = ("triton" if device == "cuda" else "torch"), box.shape
        backends.load_backend(self.backend)
        self.affine = box.affine.float().to(device)
        self.inverse = box.affine.inverse().float().to(device)
        counts = torch.tensor(box.size, device=device, dtype=torch.float32)
        self.scale = torch.diag(torch.cat([2 / counts, counts.new_ones(1)]))
        self.scale[:3, 3] = 1 / counts - 1
        self.still = torch.eye(4, device=device).expand(len(rig), 4, 4).contiguous()

    def render(self, x: Tensor, pose: Tensor) -> Tensor:
        """One volume [d h w] to views [m v u]."""
        from nanodrr.data import Subject
        from nanodrr.drr.renderer import render

        volume, none = x[None, None], torch.zeros_like(x[None, None])
        where = self.affine, self.inverse, self.scale, self.affine[:3, 3]
        subject = Subject(volume, none, *where, 0)
        subject.convert_to_mu = False
        frame = pose[:, :3, :3], pose, x.new_ones(len(pose)), *self.rig.shape, self.samples
        rays = {"src": self.source, "tgt": self.target}
        return render(subject, *frame, backend=self.backend, **rays)[:, 0]

    def forward(self, x: Tensor) -> Tensor:
        """Project volumes one by one."""
        return torch.stack([self.render(one, self.still) for one in x])

    def adjoint(self, y: Tensor) -> Tensor:
        """The derivative with respect to the volumes, one by one."""
        return torch.stack([self._fused(one) if y.is_cuda else self._autograd(one) for one in y])

    def _fused(self, y: Tensor) -> Tensor:
        """The adjoint by the fused kernel, without the forward pass of autograd."""
        M = (self.inverse @ self.still)[:, :3]
        step = (self.target - self.source).norm(dim=-1) / self.samples
        zeros = y.new_zeros(self.shape)
        geometry = M, self.source, self.target, step, self.samples, 1, self.rig.shape[1]
        back = torch.ops.nanodrr.triton_raymarch_bwd
        return back(y.flatten(1)[:, None], zeros, zeros, *geometry, True, False, False)[0]

    def _autograd(self, y: Tensor) -> Tensor:
        with torch.enable_grad():
            x = y.new_zeros(self.shape).requires_grad_()
            return torch.autograd.grad(self.render(x, self.still), x, y)[0]

    def pose(self, x: Tensor, y: Tensor) -> Any:
        """Gradients with respect to the cameras' poses, for the first volume."""
        moving = self.still.clone().requires_grad_()
        return torch.autograd.grad(self.render(x[0], moving), moving, y[0])


def nanodrr(grid: mv.Grid, rig: mv.Cameras, device: str, samples: int | None = None) -> Program:
    """nanodrr, with the number of samples per ray equal to that of voxels along the diagonal."""
    program = NanodrrModule(grid, rig, device, samples)
    return Program(program.forward, program.adjoint, program.pose)


def flashdrr(grid: mv.Grid, rig: mv.Cameras, device: str) -> Program:
    """flashdrr's fused renderer with the same number of samples and pixels; it has its own camera
    model, so values are not compared.
    """
    from flashdrr.rendering.triton_raycast import FusedVolumeRenderer

    (d, h, w), (rows, columns), count = grid.shape, rig.shape, len(rig)
    renderer = FusedVolumeRenderer(math.ceil(math.hypot(d, h, w)))
    angle, far = torch.arange(count) * (2 * math.pi / count), max(grid.shape)
    way = torch.stack([angle.cos(), angle.sin(), 0 * angle], 1)
    view = torch.eye(4).repeat(count, 1, 1)
    view[:, :2, 0], view[:, 0, 1], view[:, 1, 1] = way[:, :2], -angle.sin(), angle.cos()
    view[:, :3, 3] = torch.tensor([w, h, d]) / 2 - 4 * far * way
    u, v = ((torch.arange(n) - n / 2) / (4 * n) for n in (columns, rows))
    rays = torch.stack([torch.ones(rows, columns), *torch.meshgrid(v, u, indexing="ij")[::-1]], -1)
    rays = torch.nn.functional.normalize(rays, dim=-1).to(device)
    near, end = (torch.full((count,), k * far, device=device) for k in (3.0, 5.0))
    shape, affine = torch.tensor([d, h, w], device=device), torch.eye(4, device=device)
    geometry = view.to(device), near, end, affine, shape, rays, True

    def forward(x: Tensor) -> Tensor:
        volume = x[0].permute(2, 1, 0)[None, None].expand(count, -1, -1, -1, -1)
        return renderer(volume, *geometry)[:, 0]

    return Program(forward)


def astra(grid: mv.Grid, rig: mv.Cameras, device: str) -> Program:
    """ASTRA's 3-D kernels (texture memory) on torch tensors; its back-projection is not the
    transpose.
    """
    import astra
    import astra.experimental as direct

    if not astra.use_cuda():
        raise RuntimeError("astra.use_cuda() says no")
    (d, h, w), (rows, columns) = grid.shape, rig.shape
    x, y, z = (n * step / 2 for n, step in zip(grid.size, grid.spacing, strict=True))
    volume = astra.create_vol_geom(h, w, d, -x, x, -y, y, -z, z)
    centre = rig.origin + rig.u * (columns - 1) / 2 + rig.v * (rows - 1) / 2
    vectors = torch.cat([rig.source - grid.centre, centre - grid.centre, rig.u, rig.v], 1)
    geometry = astra.create_proj_geom("cone_vec", rows, columns, vectors.numpy())
    projector = astra.create_projector("cuda3d", geometry, volume)

    def forward(x: Tensor) -> Tensor:
        views = torch.zeros(rows, len(rig), columns, device=device)
        direct.direct_FP3D(projector, x[0].contiguous(), views)
        return views.transpose(0, 1)[None]

    def adjoint(y: Tensor) -> Tensor:
        out = torch.zeros(d, h, w, device=device)
        direct.direct_BP3D(projector, out, y[0].transpose(0, 1).contiguous())
        return out[None]

    return Program(forward, adjoint)


PROGRAMS: dict[str, Callable[[mv.Grid, mv.Cameras, str], Program]] = {
    "mvrecon joseph": ours,
    "mvrecon joseph skip=off": lambda g, r, d: ours(g, r, d, skip="off"),
    "mvrecon joseph scatter": scattered,
    "mvrecon siddon skip=off": lambda g, r, d: ours(g, r, d, method="siddon", skip="off"),
    "nanodrr": nanodrr,
    "nanodrr n samples": lambda g, r, d: nanodrr(g, r, d, max(g.shape)),
    "flashdrr": flashdrr,
    "astra cuda": astra,
    "diffdrr siddon": lambda g, r, d: diffdrr(g, r, d, "siddon"),
    "diffdrr trilinear": lambda g, r, d: diffdrr(g, r, d, "trilinear"),
}
#: Programs that support one volume; maximum number of pixels, over all volumes, for slow programs.
ONE_VOLUME = {"flashdrr", "astra cuda"}
MOST_PIXELS = {"diffdrr siddon": 2**21, "diffdrr trilinear": 2**21, "nanodrr n samples": 2**31}
