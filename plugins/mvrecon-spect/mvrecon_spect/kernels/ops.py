"""Counts of voxels behind pinholes, and their transpose, as torch operators.

The CPU and CUDA devices have kernels; the reference computes derivatives in the rig, camera by
camera.
"""

from typing import Any

import torch
from torch import Tensor

from mvrecon.kernels.operator import LinearKernel
from mvrecon_spect.kernels import reference


class PerCamera(LinearKernel):
    """An operator whose derivative in the geometry [m ..] is computed camera by camera."""

    def apply_vjp(self, values: Tensor, cotangent: Tensor, geometry: Tensor, *rest: Any) -> Tensor:
        (transmission,) = rest
        maps = [None] * len(geometry) if transmission is None else transmission.split(1)
        parts = zip(cotangent.split(1, dim=1), geometry.split(1), maps, strict=True)
        return torch.cat([super(PerCamera, self).apply_vjp(values, *part) for part in parts])


FOOTPRINTS = PerCamera(
    "project(Tensor volume, Tensor rig, SymInt[] detector, Tensor? transmission=None) -> Tensor",
    "backproject(Tensor views, Tensor rig, SymInt[] size, Tensor? transmission=None) -> Tensor",
    None,
    {"cpu": "mvrecon_spect.kernels.cpu", "cuda": "mvrecon_spect.kernels.cuda"},
    reference.project,
    shapes=(
        lambda volume, rig, detector, *_: (volume.shape[0], rig.shape[0], *detector),
        lambda views, rig, size, *_: (views.shape[0], *size),
    ),
    sizes=(slice(1, 4), slice(2, 4)),
    prefix="footprints_",
)
project, backproject = FOOTPRINTS.forward, FOOTPRINTS.transpose
