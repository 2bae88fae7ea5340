"""Tasks of `bench=skip`: forward, adjoint and SIRT with one operator in each mode of skipping.

Two modes skip nothing: "off" on the entire cube, and "cropped", which is off on the bounding box of
the nonzero voxels, as a careful user would crop by hand. Their times exclude the mask that
determines the box; those of all other modes include it.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from mvrecon.geometry.cameras.camera import Cameras
from mvrecon.geometry.grid import Box, Grid, placed
from mvrecon.methods.classical.sirt import sirt
from mvrecon.operators.ray_transform import RayTransform
from mvrecon.operators.visual_hull.support import support_from_views
from mvrecon_bench.benchmarks.skip_scenes import Filled

OFF, CROPPED = "off", "cropped"
DENSE = (OFF, CROPPED)
ITERATIONS = 20


@dataclass(frozen=True, eq=False)
class SkipTrial:
    """One mode of one task.

    Args:
        call: the timed call.
        whole: pads its result to the grid or detectors of "off" for comparison.
        choice: mode of the last call, and the reason.
        build: computes the mask, once per support; None: no mask, or every call computes its own.
        charged: whether that time is added to the call's.
        score: PSNR in dB, for trained models.
    """

    call: Callable[[], Tensor]
    whole: Callable[[Tensor], Tensor]
    choice: Callable[[], tuple[str, str]]
    build: Callable[[], Any] | None = None
    charged: bool = False
    score: Callable[[], float] | None = None


@dataclass(frozen=True, eq=False)
class Bed:
    """A volume with a rig, for one method.

    Args:
        filled: the volume and its grid.
        cameras: the rig.
        method: method of the projector.
        device: device of all tensors.
        support: the voxels that may be nonzero; None: the nonzero voxels.
    """

    filled: Filled
    cameras: Cameras
    method: str
    device: str = "cpu"
    support: Bool[Tensor, "d h w"] | None = None

    @property
    def grid(self) -> Grid:
        """Projector on the entire cube."""
        return self.filled.grid

    @cached_property
    def volume(self) -> Float[Tensor, "1 1 d h w"]:
        """The volume on the device."""
        return self.filled.volume[None, None].to(self.device)

    @cached_property
    def mask(self) -> Bool[Tensor, "d h w"]:
        """The support."""
        return self.volume[0, 0] != 0 if self.support is None else self.support

    @cached_property
    def box(self) -> Box:
        """Bounding box of the support."""
        return Box.around(self.mask)

    @cached_property
    def views(self) -> Float[Tensor, "1 1 m v u"]:
        """Noise-free views of the volume."""
        return self.operator(OFF)(self.volume)

    def hull(self) -> Bool[Tensor, "d h w"]:
        """Support computed from the views."""
        mask = support_from_views(self.views, self.cameras, self.grid, kind="hull").mask
        return torch.ones_like(self.mask) if mask is None else mask[0, 0]

    @cached_property
    def within_hull(self) -> "Bed":
        """The same case with another support."""
        return replace(self, support=self.hull())

    def operator(self, mode: str, masked: bool = False) -> RayTransform:
        """The projector in a mode, optionally with the support."""
        grid = self.grid.cropped(self.box) if mode == CROPPED else self.grid
        support = self.cut(self.mask, mode) if masked else None
        skip = OFF if mode in DENSE else mode
        A = RayTransform(grid, self.cameras, self.method, skip=skip, support=support)
        return A.to(self.device)

    def cut(self, volume: Tensor, mode: str) -> Tensor:
        """The part of a volume that a mode processes."""
        return volume[..., *self.box.slices].contiguous() if mode == CROPPED else volume

    def pasted(self, part: Tensor, mode: str) -> Tensor:
        """The inverse of `cut`, zero elsewhere."""
        return placed(part, self.box, self.grid.shape) if mode == CROPPED else part


def forward(bed: Bed, mode: str) -> SkipTrial:
    """A x of a new volume at every call: its nonzero voxels are determined every time."""
    A, x = bed.operator(mode), bed.cut(bed.volume, mode).clone()

    def call() -> Tensor:
        x[..., :1, :1, :1].mul_(1)  # a new volume according to its version counter
        return A(x)

    return SkipTrial(call, _same, _choice(A, mode))


def forward_static(bed: Bed, mode: str) -> SkipTrial:
    """A x with a precomputed support."""
    A, x = bed.operator(mode, masked=mode not in DENSE), bed.cut(bed.volume, mode)
    return SkipTrial(lambda: A(x), _same, _choice(A, mode), _rebuilding(A, bed, mode))


def adjoint(bed: Bed, mode: str) -> SkipTrial:
    """A^T y within a precomputed support for views of white noise, without empty rays."""
    A = bed.operator(mode, masked=mode not in DENSE)
    y = torch.randn(
        1, 1, len(bed.cameras), *bed.cameras.shape, generator=torch.Generator().manual_seed(0)
    )
    y = y.to(bed.device)

    def whole(part: Tensor) -> Tensor:
        return torch.where(bed.mask, bed.pasted(part, mode), 0)

    return SkipTrial(lambda: A.T(y), whole, _choice(A, mode), _rebuilding(A, bed, mode))


def reconstruction(bed: Bed, mode: str) -> SkipTrial:
    """SIRT within the visual hull of the views. All modes have this support, so that they return
    the same volume.
    """
    within = bed.within_hull
    A = within.operator(mode, masked=True)
    build = None if mode in DENSE else lambda: A.with_support(within.hull())
    call, whole = (
        (lambda: sirt(A, within.views, ITERATIONS)),
        (lambda part: within.pasted(part, mode)),
    )
    return SkipTrial(call, whole, _choice(A, mode), build, charged=True)


def _same(views: Tensor) -> Tensor:
    return views


def _choice(A: RayTransform, mode: str) -> Callable[[], tuple[str, str]]:
    return lambda: (OFF, "") if mode in DENSE else (A.skipped.mode, A.skipped.why)


def _rebuilding(A: RayTransform, bed: Bed, mode: str) -> Callable[[], Any] | None:
    return None if mode in DENSE else lambda: A.with_support(bed.mask)


#: Task -> function that builds a mode of it.
TASKS: dict[str, Callable[[Bed, str], SkipTrial]] = {
    "forward": forward,
    "forward_static": forward_static,
    "adjoint": adjoint,
    f"sirt{ITERATIONS}": reconstruction,
}
