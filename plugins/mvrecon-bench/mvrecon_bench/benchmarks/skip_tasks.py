"""Tasks of `bench=skip`: forward, adjoint and SIRT with one operator in each mode of skipping.

Two modes skip nothing: "off" on the whole cube, and "cropped", off on the box around what is there,
which is what a careful user does by hand. Neither pays for the mask that tells the box; every other
mode does.
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
class Trial:
    """One mode at one task.

    Args:
        call: what is timed.
        whole: its result on the grid or the detectors of "off", so that they can be compared.
        choice: mode that the last call chose, and why.
        build: makes the mask, once for a support; None: there is none, or every call makes its own.
        charged: whether that time counts with the call's.
        score: PSNR in dB, where there is something that was trained for it.
    """

    call: Callable[[], Tensor]
    whole: Callable[[Tensor], Tensor]
    choice: Callable[[], tuple[str, str]]
    build: Callable[[], Any] | None = None
    charged: bool = False
    score: Callable[[], float] | None = None


@dataclass(frozen=True, eq=False)
class Bed:
    """A volume under a rig, for one method.

    Args:
        filled: the volume and its grid.
        cameras: the rig.
        method: of the projector.
        device: where all of it is.
        support: the voxels that may be anything but zero; None: those that are not.
    """

    filled: Filled
    cameras: Cameras
    method: str
    device: str = "cpu"
    support: Bool[Tensor, "d h w"] | None = None

    @property
    def grid(self) -> Grid:
        """Of the whole cube."""
        return self.filled.grid

    @cached_property
    def volume(self) -> Float[Tensor, "1 1 d h w"]:
        """On the device."""
        return self.filled.volume[None, None].to(self.device)

    @cached_property
    def mask(self) -> Bool[Tensor, "d h w"]:
        """The support."""
        return self.volume[0, 0] != 0 if self.support is None else self.support

    @cached_property
    def box(self) -> Box:
        """Around the support."""
        return Box.around(self.mask)

    @cached_property
    def views(self) -> Float[Tensor, "1 1 m v u"]:
        """Of the volume, without noise."""
        return self.operator(OFF)(self.volume)

    def hull(self) -> Bool[Tensor, "d h w"]:
        """The support from the views."""
        mask = support_from_views(self.views, self.cameras, self.grid, kind="hull").mask
        return torch.ones_like(self.mask) if mask is None else mask[0, 0]

    @cached_property
    def within_hull(self) -> "Bed":
        """The same with that support."""
        return replace(self, support=self.hull())

    def operator(self, mode: str, masked: bool = False) -> RayTransform:
        """The projector in a mode, with the support as part of it or not."""
        grid = self.grid.cropped(self.box) if mode == CROPPED else self.grid
        support = self.cut(self.mask, mode) if masked else None
        skip = OFF if mode in DENSE else mode
        A = RayTransform(grid, self.cameras, self.method, skip=skip, support=support)
        return A.to(self.device)

    def cut(self, volume: Tensor, mode: str) -> Tensor:
        """What a mode works on of a volume."""
        return volume[..., *self.box.slices].contiguous() if mode == CROPPED else volume

    def pasted(self, part: Tensor, mode: str) -> Tensor:
        """The inverse of `cut`, zero elsewhere."""
        return placed(part, self.box, self.grid.shape) if mode == CROPPED else part


def forward(bed: Bed, mode: str) -> Trial:
    """A x of a volume that is another at every call: what is there of it is found anew from its
    values.
    """
    A, x = bed.operator(mode), bed.cut(bed.volume, mode).clone()

    def call() -> Tensor:
        x[..., :1, :1, :1].mul_(1)  # another, as far as its version tells
        return A(x)

    return Trial(call, _same, _choice(A, mode))


def forward_static(bed: Bed, mode: str) -> Trial:
    """A x with the support given once."""
    A, x = bed.operator(mode, masked=mode not in DENSE), bed.cut(bed.volume, mode)
    return Trial(lambda: A(x), _same, _choice(A, mode), _rebuilding(A, bed, mode))


def adjoint(bed: Bed, mode: str) -> Trial:
    """A^T y inside the support, given once, for views of white noise, in which no ray is empty."""
    A = bed.operator(mode, masked=mode not in DENSE)
    y = torch.randn(
        1, 1, len(bed.cameras), *bed.cameras.shape, generator=torch.Generator().manual_seed(0)
    )
    y = y.to(bed.device)

    def whole(part: Tensor) -> Tensor:
        return torch.where(bed.mask, bed.pasted(part, mode), 0)

    return Trial(lambda: A.T(y), whole, _choice(A, mode), _rebuilding(A, bed, mode))


def reconstruction(bed: Bed, mode: str) -> Trial:
    """SIRT inside the hull of the views. Every mode has that support, so that all find the same
    volume.
    """
    within = bed.within_hull
    A = within.operator(mode, masked=True)
    build = None if mode in DENSE else lambda: A.with_support(within.hull())
    call, whole = (
        (lambda: sirt(A, within.views, ITERATIONS)),
        (lambda part: within.pasted(part, mode)),
    )
    return Trial(call, whole, _choice(A, mode), build, charged=True)


def _same(views: Tensor) -> Tensor:
    return views


def _choice(A: RayTransform, mode: str) -> Callable[[], tuple[str, str]]:
    return lambda: (OFF, "") if mode in DENSE else (A.skipped.mode, A.skipped.why)


def _rebuilding(A: RayTransform, bed: Bed, mode: str) -> Callable[[], Any] | None:
    return None if mode in DENSE else lambda: A.with_support(bed.mask)


#: Task -> how a mode of it is set up.
TASKS: dict[str, Callable[[Bed, str], Trial]] = {
    "forward": forward,
    "forward_static": forward_static,
    "adjoint": adjoint,
    f"sirt{ITERATIONS}": reconstruction,
}
