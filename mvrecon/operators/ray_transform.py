"""The ray transform: integrals of the volumes of one grid along the rays of one rig, and its
matched adjoint.
"""

import math
from collections.abc import Sequence
from copy import copy
from types import ModuleType

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import avg_pool2d
from torch.utils.weak import WeakIdRef

from mvrecon.geometry.cameras.camera import Cameras, ExplicitRays
from mvrecon.geometry.cameras.symmetry import Mirror, mirror_pairs
from mvrecon.geometry.grid import Box, Grid, placed, subdivided
from mvrecon.kernels import operator as operators
from mvrecon.kernels.operator import to_accumulation_dtype
from mvrecon.kernels.rays import ops, reference
from mvrecon.kernels.rays.lines import lines_of, lines_of_rays
from mvrecon.kernels.rays.occupancy import Occupancy
from mvrecon.operators.checks import check, check_floating
from mvrecon.operators.memo import FixedGeometry, kept
from mvrecon.operators.operator import Cropped, LinearOperator, PixelIntegral, Projector
from mvrecon.operators.selection import (
    SKIPS,
    RaySelection,
    Skipped,
    SomeRays,
    ViewSelection,
    check_support,
    skip_report,
    verify,
    within,
)

RAY_METHODS = ("joseph", "siddon", "trilinear")


class RayTransform(FixedGeometry):
    """y = A x: integrals of volumes along the rays of a rig, in (unit of x) * mm.

    Differentiable in the volume, in the adjoint's views, and in the cameras' tensors, whose second
    derivatives the reference computes. Half and bfloat16 inputs are summed in float32, which is
    also the output's dtype. Geometry stays in float64 whatever the module is cast to, and grid and
    cameras on their device; `.to(device)` moves the operator. Cameras that require a gradient may
    change; others must not after construction. `last_backend` and `skipped` report the last call's
    back end and skipped voxels.

    Args:
        grid: the voxels.
        cameras: the rig, or explicit rays.
        method: "joseph", second order in the voxel size for smooth volumes, first across sharp
            edges, with a step where a ray's main axis changes; "siddon", exact for piecewise
            constant volumes, first order otherwise; or "trilinear", second order in the sample
            distance too, and slower than "joseph" without gain. It takes as many samples per ray as
            voxels along the grid's diagonal; "trilinear:300" takes 300.
        backend: "cpu" or "cuda" (compiled), "reference" (torch, any device and order of
            derivative), or "auto": the compiled one of the tensors' device if available, else
            reference.
        rays_per_pixel: a pixel is the mean over so many rays each way (1: the thin ray at its
            centre); 1 for explicit rays.
        skip: parts of a volume that `forward` skips: "off", none; "box", outside the bounding box
            of its non-zero voxels; "brick", also its empty bricks of 8 voxels a side; "auto", the
            fastest of these. Determined in every call; the views are bitwise the same. "verify"
            also computes without skipping, and raises if a bit differs. The gradient by the volume
            stays dense.
        support: mask [d h w] of the voxels that may differ from zero. The operator becomes A
            diag(support), its adjoint diag(support) A^T; voxels outside are neither read nor
            written.

    Raises:
        ValueError: an unknown method, back end or skip mode, counts below one, several rays per
            pixel with explicit rays, or a support of another shape.
    """

    capabilities = frozenset({"subset", "crop", "support", "refine"})
    support: Tensor | None

    def __init_subclass__(cls, **options: object) -> None:
        """A subclass with another `forward` inherits only the parts by the whole operator: correct,
        but without savings.
        """
        super().__init_subclass__(**options)
        if {"forward", "adjoint"} & vars(cls).keys():
            cls.capabilities = frozenset()

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
        names = {"method": RAY_METHODS, "backend": operators.BACKENDS, "skip": SKIPS}
        for what, name in (
            ("method", method.partition(":")[0]),
            ("backend", backend),
            ("skip", skip),
        ):
            if name not in names[what]:
                raise ValueError(f"Unknown {what} {name!r}. Known: {', '.join(names[what])}")
        self.built_from(grid, cameras)
        self._method, self._rays_per_pixel, self.backend = method, rays_per_pixel, backend
        self.domain_shape, self.range_shape = grid.shape, (len(cameras), *cameras.shape)
        self.kernel, self.skip = _kernel(method, grid), skip
        self.last_backend: str | None = None
        self.ray_extent = list(cameras.ray_extent)
        with torch.inference_mode(False):  # else no derivative could save them
            lines = self._lines()
        # without a graph, but with torch.func's levels
        self.register_buffer(
            "fixed_lines", lines.detach() if lines.requires_grad else lines, persistent=False
        )
        self.register_buffer("support", None, persistent=False)
        self._restrict(support)

    @staticmethod
    def check_rig(cameras: Cameras | ExplicitRays) -> None:
        """Check the rays before the operator is built; subclasses override it.

        Raises:
            ValueError: rays that the operator does not support.
        """

    @property
    def method(self) -> str:
        """The discretisation; fixed, as the number of rays, by what was computed from it."""
        return self._method

    @property
    def rays_per_pixel(self) -> int:
        """Rays each way over a pixel."""
        return self._rays_per_pixel

    @property
    def device(self) -> torch.device:
        """Device of the computation."""
        return self.fixed_lines.device

    @property
    def skipped(self) -> Skipped:
        """Voxels that the last call skipped, and the reason."""
        return skip_report(self._last, self.skip, self.grid.shape)

    def _lines(self) -> Float[Tensor, "m 4 3 k"]:
        if isinstance(self.rays, ExplicitRays):
            if self.rays_per_pixel != 1:
                raise ValueError(
                    f"Explicit rays are one per pixel, got rays_per_pixel={self.rays_per_pixel}"
                )
            return lines_of_rays(self.rays, self.grid)
        return lines_of(self.rays.refined(self.rays_per_pixel), self.grid)

    def _apply(self, fn, recurse: bool = True):
        exact = self.fixed_lines
        super()._apply(fn, recurse)
        self.fixed_lines = exact.to(self.fixed_lines.device)
        return self

    @property
    def lines(self) -> Float[Tensor, "m 4 3 k"]:
        """The rays in voxel space; recomputed, with a graph, if the cameras require a gradient.

        Raises:
            RuntimeError: cameras without a gradient were changed in place; not detected in graphs
                of `torch.compile`.
        """
        if self.pose_gradient:
            return self._lines().to(self.fixed_lines.device)
        self.check_unchanged()
        return self.fixed_lines

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
        """Integrals along rays in voxel space, see `kernels/rays/lines.py`; the detector's size is
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
            code, box = self._occupied
            self._last = code
            part = within(x[:, *box.slices], self.support[box.slices])
            return kernels.project(part, *rays, code)
        if self.skip == "off":
            self._last = None
            return kernels.project(x, *rays)
        how = self.skip if self.skip in ("box", "brick") else "auto"
        # not read from self again: another thread may project meanwhile
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
        code, box = self._occupied
        self._last = code
        part = kernels.backproject(
            views, lines, self.ray_extent, list(box.shape), self.kernel, code
        )
        return placed(within(part, self.support[box.slices]), box, self.grid.shape)

    def _restrict(self, support: Bool[Tensor, "d h w"] | None) -> None:
        """Set the support."""
        mask = check_support(support, self.grid.shape)
        self.support = None if mask is None else mask.to(self.device)
        self._last: Tensor | None = None
        if mask is not None:
            _ = self._occupied

    @property
    def _occupied(self) -> tuple[Tensor, Box]:
        """Occupancy code and box of the support, which may have changed except in traced
        programs.
        """
        if torch.compiler.is_compiling():
            return self._inside
        key = "occupied", self.skip, self.kernel, *self.detector, WeakIdRef(self.fixed_lines)
        self._inside = inside = kept(self.support, key, self._occupancy)
        return inside

    def _occupancy(self) -> tuple[Tensor, Box]:
        mask = check_support(self.support, self.grid.shape)
        occupancy = Occupancy.whole(self.grid.shape)
        if mask is not None and self.skip != "off" and operators.COMPILED:
            voxels, rays = mask[None].to("cpu", torch.uint8), self.fixed_lines.cpu()
            how = self.skip if self.skip in ("box", "brick") else "once"
            code = ops.occupied(voxels, rays, self.ray_extent, self.detector, self.kernel, how)
            occupancy = Occupancy.unwrapped(code)
        return occupancy.encoded(), occupancy.box

    def _kernels(self, tensor: Tensor) -> ModuleType:
        self.last_backend = ops.backend_for(tensor, self.backend, self.kernel)
        return reference if self.last_backend == "reference" else ops

    def subset(self, selection: LinearOperator) -> LinearOperator:
        """The operator of some views or pixels only."""
        chooses = isinstance(selection, ViewSelection | RaySelection)
        if chooses and "subset" in self.capabilities:
            return SomeRays(self, selection)
        return super().subset(selection)

    def cropped(self, box: Box, views: Sequence[int] | None = None) -> Projector:
        """The operator for the voxels of a box and for some cameras, with the same options. If the
        cameras require a gradient, the views of all are computed.

        Raises:
            ValueError: as `cameras`.
        """
        if "crop" not in self.capabilities:
            return super().cropped(box, views)
        if views is not None and self.pose_gradient:  # selected vectors would not follow the rig
            return Cropped(self.cropped(box), Box.whole(box.shape), views)
        support = None if self.support is None else self.support[box.slices].cpu()
        rig = self.cameras
        cameras = rig if views is None else rig[torch.tensor(views, device=rig.source.device)]
        return self._like(self.grid.cropped(box), cameras, support, self.rays_per_pixel)

    def refined(self, factor: int) -> Projector:
        """The operator on a finer grid with denser rays, with the same options.

        Raises:
            ValueError: explicit rays, or a subclass with another `forward`.
        """
        if "refine" not in self.capabilities:
            return super().refined(factor)
        support = None if self.support is None else subdivided(self.support.cpu(), factor)
        rays = factor * self.rays_per_pixel
        return self._like(self.grid.refined(factor), self.cameras, support, rays)

    def _like(
        self, grid: Grid, cameras: Cameras, support: Bool[Tensor, "d h w"] | None, rays: int
    ) -> "RayTransform":
        """An operator with the same options, on another grid."""
        options = (self.method, self.backend, rays, self.skip, support)
        return RayTransform(grid, cameras, *options).to(self.device)

    def pixel_integral(self) -> PixelIntegral | None:
        """The line integral, or its mean over a pixel's rays; None with a support, which the object
        may exceed, and for explicit rays.
        """
        if self.support is not None or isinstance(self.rays, ExplicitRays):
            return None
        return PixelIntegral(rays=self.rays_per_pixel)

    def mirror(self) -> Mirror | None:
        """A plane that mirrors grid, rig and support into themselves."""
        # "siddon" assigns a ray in the face between two voxels to one of them, not to its mirror
        # image
        exact = bool(self.capabilities) and self.method != "siddon"
        if not exact or isinstance(self.rays, ExplicitRays):
            return None
        mirror = mirror_pairs(self.rays, self.grid)
        if mirror is None or mirror.share.all():
            return None
        fits = self.support is None or torch.equal(mirror.volume(self.support), self.support)
        return mirror if fits else None

    def with_support(self, support: Bool[Tensor, "d h w"] | None) -> LinearOperator:
        """The same operator with another support, or with none."""
        if "support" not in self.capabilities:
            return super().with_support(check_support(support, self.grid.shape))
        other = copy(self)
        other._buffers = dict(self._buffers)
        other._restrict(support)
        return other

    def forward(self, volume: Float[Tensor, "b c d h w"]) -> Float[Tensor, "b c m v u"]:
        """Views of volumes.

        Raises:
            ValueError: a wrong rank, size, device or dtype.
            RuntimeError: skip is "verify", and a view is not the same without skipping.
        """
        views = self.project_along(volume, self.lines, self.detector)
        if self.rays_per_pixel > 1:
            views = avg_pool2d(views, self.rays_per_pixel)
        return views.reshape(*volume.shape[:2], *self.range_shape)

    def adjoint(self, views: Float[Tensor, "b c m v u"]) -> Float[Tensor, "b c d h w"]:
        """Return volumes from views: every value spread along its ray with the weights of
        `forward`; zero pixels are skipped.

        Raises:
            ValueError: a wrong rank, size, device or dtype.
        """
        check(views, "views [b c m v u]", self.range_shape, self.device)
        check_floating(views, "views")
        y, r = to_accumulation_dtype(views).flatten(0, 1), self.rays_per_pixel
        if r > 1:
            y = (y / r**2).repeat_interleave(r, dim=2).repeat_interleave(r, dim=3)
        y = y.reshape(len(y), len(self.fixed_lines), *self.detector)
        return self.backproject_along(y, self.lines).unflatten(0, views.shape[:2])

    def extra_repr(self) -> str:
        return (
            f"{len(self.rays)} views of {self.rays.shape}, grid {self.grid.shape}, "
            f"{self.method}, {self.backend}"
        )


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
