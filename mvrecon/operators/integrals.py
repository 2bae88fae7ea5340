"""Line integrals of volumes along the rays of a rig: rays in voxel space, choice of the back end,
skipping of zeros.
"""

import math
from collections.abc import Sequence
from types import ModuleType

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from mvrecon.geometry.box import Box, placed
from mvrecon.geometry.cameras.camera import Cameras
from mvrecon.geometry.cameras.explicit import ExplicitRays
from mvrecon.geometry.grid import Grid
from mvrecon.kernels import operator as operators
from mvrecon.kernels.device_cache import tensors_of, writes
from mvrecon.kernels.operator import to_accumulation_dtype
from mvrecon.kernels.rays import ops, reference
from mvrecon.kernels.rays.lines import lines_of, lines_of_rays
from mvrecon.kernels.rays.occupancy import Occupancy
from mvrecon.operators.checks import check, check_floating
from mvrecon.operators.operator import Projector
from mvrecon.operators.skipping import SKIPS, Skipped, check_support, skip_report, verify, within

METHODS = ("joseph", "siddon", "trilinear")


class LineIntegrals(Projector):
    """Integrals along lines in voxel space, and their transpose; options as `RayTransform`."""

    support: Tensor | None

    def __init__(
        self,
        grid: Grid,
        cameras: Cameras | ExplicitRays,
        method: str = "joseph",
        backend: str = "auto",
        rays_per_pixel: int = 1,
        skip: str = "auto",
        support: Bool[Tensor, "d h w"] | None = None,
    ):
        super().__init__()
        self.check_rig(cameras)
        names = {"method": METHODS, "backend": operators.BACKENDS, "skip": SKIPS}
        for what, name in (
            ("method", method.partition(":")[0]),
            ("backend", backend),
            ("skip", skip),
        ):
            if name not in names[what]:
                raise ValueError(f"Unknown {what} {name!r}. Known: {', '.join(names[what])}")
        self.grid, self.rays, self.method, self.backend = grid, cameras, method, backend
        self.domain_shape, self.range_shape = grid.shape, (len(cameras), *cameras.shape)
        self.kernel, self.rays_per_pixel, self.skip = _kernel(method, grid), rays_per_pixel, skip
        self.last_backend: str | None = None
        self.ray_extent = list(cameras.ray_extent)
        lines = self._lines()
        # without a graph, but with what torch.func knows of them
        self.register_buffer(
            "fixed_lines", lines.detach() if lines.requires_grad else lines, persistent=False
        )
        self._written = writes(cameras)
        mask = check_support(support, grid)
        mask = None if mask is None else mask.to(lines.device)
        self.register_buffer("support", mask, persistent=False)
        self._support_code, self._support_box = self._occupied_by_support()
        self._last: Tensor | None = None

    @staticmethod
    def check_rig(cameras: Cameras | ExplicitRays) -> None:
        """Check of the rays before the operator is built; a subclass refuses those that it does
        not take.

        Raises:
            ValueError: rays that the operator does not take.
        """

    @property
    def device(self) -> torch.device:
        """Where the operator computes."""
        return self.fixed_lines.device

    @property
    def cameras(self) -> Cameras:
        """The rig.

        Raises:
            ValueError: the rays were given one by one, and have no cameras with frusta.
        """
        if isinstance(self.rays, ExplicitRays):
            raise ValueError(
                "This needs cameras, which the projector has not: it was given explicit rays"
            )
        return self.rays

    @property
    def skipped(self) -> Skipped:
        """Voxels that the last call skipped, and why."""
        return skip_report(self._last, self.skip, self.grid.shape)

    def _lines(self) -> Float[Tensor, "m 4 3 k"]:
        if isinstance(self.rays, ExplicitRays):
            if self.rays_per_pixel != 1:
                raise ValueError(
                    f"Explicit rays are one a pixel, got rays_per_pixel={self.rays_per_pixel}"
                )
            return lines_of_rays(self.rays, self.grid)
        return lines_of(self.rays.refined(self.rays_per_pixel), self.grid)

    def _apply(self, fn, recurse: bool = True):
        exact = self.fixed_lines
        super()._apply(fn, recurse)
        self.fixed_lines = exact.to(self.fixed_lines.device)
        return self

    @property
    def pose_gradient(self) -> bool:
        """Whether the cameras require a gradient; the rays are then computed in every call."""
        return any(tensor.requires_grad for tensor in tensors_of(self.rays))

    @property
    def lines(self) -> Float[Tensor, "m 4 3 k"]:
        """The rays in voxel space; computed again, with a graph, if the cameras require a gradient.

        Raises:
            RuntimeError: cameras without a gradient were changed in place; not seen in graphs of
                `torch.compile`.
        """
        if self.pose_gradient:
            return self._lines().to(self.fixed_lines.device)
        if not torch.compiler.is_compiling() and writes(self.rays) != self._written:
            raise RuntimeError(
                "The cameras' tensors were changed in place after the projector was built; build "
                "another one, or let "
                "them want a gradient before"
            )
        return self.fixed_lines

    def __reduce_ex__(self, protocol):
        """What copies and pickles are made of; raises as `lines` does."""
        _ = self.lines
        return super().__reduce_ex__(protocol)

    def __setstate__(self, state):
        super().__setstate__(state)
        self._written = writes(self.rays)  # a copied tensor counts from zero

    @property
    def detector(self) -> list[int]:
        """Rays (rows, columns) of one of the views that `lines` describes."""
        explicit = isinstance(self.rays, ExplicitRays)
        return [1, 1] if explicit else [n * self.rays_per_pixel for n in self.rays.shape]

    def project_along(
        self,
        volume: Float[Tensor, "b c d h w"],
        lines: Float[Tensor, "r 4 3 k"],
        detector: Sequence[int],
    ) -> Float[Tensor, "n r v u"]:
        """Integrals along rays in voxel space, see `kernels/rays/lines.py`; a detector has so many
        (rows, columns).
        """
        check(volume, "a volume [b c d h w]", self.domain_shape, self.device)
        check_floating(volume, "a volume")
        x, kernels = volume.flatten(0, 1), self._kernels(volume)
        rays = lines, self.ray_extent, list(detector), self.kernel
        if kernels is reference:
            self._last = None
            return kernels.project(
                to_accumulation_dtype(x if self.support is None else within(x, self.support)), *rays
            )
        if self.support is not None:
            self._last, box = self._support_code, self._support_box
            part = within(x[:, *box.slices], self.support[box.slices])
            return kernels.project(part, *rays, self._support_code)
        if self.skip == "off":
            self._last = None
            return kernels.project(x, *rays)
        how = self.skip if self.skip in ("box", "brick") else "auto"
        # not read from self again: another thread may project another volume meanwhile
        self._last = occupancy = kernels.occupied(x.detach(), lines.detach(), *rays[1:], how)
        views = kernels.project(x, *rays, None, occupancy)
        if self.skip == "verify":
            verify(views, kernels.project(x, *rays), self.skipped)
        return views

    def backproject_along(
        self, views: Float[Tensor, "n r v u"], lines: Float[Tensor, "r 4 3 k"]
    ) -> Float[Tensor, "n d h w"]:
        """The transpose of `project_along`; views in the precision of arithmetic."""
        kernels, shape = self._kernels(views[:, None]), list(self.grid.shape)
        if self.support is None:
            return kernels.backproject(views, lines, self.ray_extent, shape, self.kernel)
        if kernels is reference:
            return within(
                kernels.backproject(views, lines, self.ray_extent, shape, self.kernel), self.support
            )
        self._last, box = self._support_code, self._support_box
        part = kernels.backproject(
            views, lines, self.ray_extent, list(box.shape), self.kernel, self._support_code
        )
        return placed(within(part, self.support[box.slices]), box, self.grid.shape)

    def _occupied_by_support(self) -> tuple[Tensor, Box]:
        """The occupancy code of the support, and the box around it."""
        occupancy = Occupancy.whole(self.grid.shape)
        if self.support is not None and self.skip != "off" and operators.COMPILED:
            mask, rays = self.support[None].to("cpu", torch.uint8), self.fixed_lines.cpu()
            how = self.skip if self.skip in ("box", "brick") else "once"
            code = ops.occupied(mask, rays, self.ray_extent, self.detector, self.kernel, how)
            occupancy = Occupancy.unwrapped(code)
        return occupancy.encoded(), occupancy.box

    def _kernels(self, tensor: Tensor) -> ModuleType:
        self.last_backend = ops.backend_for(tensor, self.backend, self.kernel)
        return reference if self.last_backend == "reference" else ops


def _kernel(method: str, grid: Grid) -> str:
    name, colon, samples = method.partition(":")
    if name != "trilinear":
        if colon:
            raise ValueError(f"Samples go with method 'trilinear', got {method!r}")
        return name
    if not colon:
        return f"{name}:{math.ceil(math.hypot(*grid.shape))}"
    if not samples.isdecimal() or int(samples) < 1:
        raise ValueError(
            f"A ray needs a positive number of samples, as in 'trilinear:300', got {method!r}"
        )
    return method
