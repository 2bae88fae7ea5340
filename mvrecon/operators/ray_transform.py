"""The ray transform: integrals of the volumes of one grid along the rays of one rig, and its
matched adjoint.
"""

from collections.abc import Sequence
from copy import copy

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import avg_pool2d

from mvrecon.geometry.box import Box
from mvrecon.geometry.cameras.camera import Cameras
from mvrecon.geometry.cameras.explicit import ExplicitRays
from mvrecon.geometry.cameras.symmetry import Mirror, mirror_pairs
from mvrecon.geometry.grid import Grid, subdivided
from mvrecon.kernels.operator import to_accumulation_dtype
from mvrecon.operators.checks import check, check_floating
from mvrecon.operators.integrals import LineIntegrals
from mvrecon.operators.operator import Derived, LinearOperator, PixelIntegral, Projector
from mvrecon.operators.selection import RaySelection, ViewSelection
from mvrecon.operators.skipping import check_support


class SomeRays(Derived):
    """Some rows of a ray transform: the chosen entries of A x, and the matched adjoint.

    Differentiable as the transform is, in the cameras' tensors too, and on its device. The values
    are the whole operator's up to rounding, since sums may be taken in another order: to about 1e-6
    of their norm in float32, 1e-12 in float64. Fixed rays are kept: 96 bytes for each view's or
    pixel's, 288 where a pixel has several.

    Args:
        A: the ray transform.
        selection: the views or pixels, an operator on all views.
    """

    #: Pixels (rows, columns) of each of the views that `lines` describes.
    detector: tuple[int, int]

    def __init__(self, A: LineIntegrals, selection: LinearOperator):
        self.A, self.selection = A, selection
        self.domain_shape, self.range_shape = A.domain_shape, selection.range_shape
        self._prepare()
        self._fixed = None if A.pose_gradient else self._choose(A.lines)

    def _prepare(self) -> None:
        """Compute what does not depend on the position of the rays."""
        raise NotImplementedError

    def _choose(self, lines: Float[Tensor, "m 4 3 k"]) -> Float[Tensor, "n 4 3 k"]:
        """The rays' lines."""
        raise NotImplementedError

    @property
    def lines(self) -> Float[Tensor, "n 4 3 k"]:
        """The rays in voxel space; computed again, with a graph, if the cameras require a
        gradient.
        """
        lines = self.A.lines
        if self.A.pose_gradient or self._fixed is None:
            return self._choose(lines)
        return self._fixed.to(lines.device)

    def forward(self, x: Float[Tensor, "b c d h w"]) -> Float[Tensor, "b c *n"]:
        """The chosen entries of A x.

        Raises:
            ValueError: a wrong rank, size or device.
        """
        r = self.A.rays_per_pixel
        rays = self.A.project_along(x, self.lines, [n * r for n in self.detector])
        # as a batch, which may be empty
        rays = avg_pool2d(rays.flatten(0, 1)[:, None], r) if r > 1 else rays
        return self._sorted(rays.reshape(*x.shape[:2], *self.range_shape))

    def adjoint(self, y: Float[Tensor, "b c *n"]) -> Float[Tensor, "b c d h w"]:
        """Volumes from the chosen entries, as if all others were zero.

        Raises:
            ValueError: a wrong rank, size or dtype.
        """
        if y.ndim != 2 + len(self.range_shape) or tuple(y.shape[2:]) != self.range_shape:
            expected = f"values [b c ..] with last sizes {self.range_shape}"
            raise ValueError(f"Expected {expected}, got {tuple(y.shape)}")
        check_floating(y, "values")
        lines, r, n = self.lines, self.A.rays_per_pixel, y.shape[0] * y.shape[1]
        rays = self._walked(to_accumulation_dtype(y)).reshape(n, len(lines), *self.detector)
        if r > 1:
            rays = (rays / r**2).repeat_interleave(r, dim=2).repeat_interleave(r, dim=3)
        return self.A.backproject_along(rays, lines).unflatten(0, y.shape[:2])

    def _walked(self, values: Float[Tensor, "b c *n"]) -> Float[Tensor, "b c *n"]:
        """Values in the order of `lines`."""
        return values

    def _sorted(self, values: Float[Tensor, "b c *n"]) -> Float[Tensor, "b c *n"]:
        """The inverse of `_walked`."""
        return values


class SomePixels(SomeRays):
    """Chosen pixels of a ray transform: volumes [b c d h w] to values [b c r]."""

    selection: RaySelection

    def _prepare(self) -> None:
        _, rows, columns = self.selection.domain_shape
        index = self.selection.index.to(self.device)
        u, row = index % columns, index // columns
        view, v = row // rows, row % rows
        # column by column: rays in turn mostly differ in z, and meet again the voxels that the
        # cache holds
        walk = ((view * columns + u) * rows + v).argsort()
        self.pixels, self.detector = torch.stack([view, v, u]).index_select(1, walk), (1, 1)
        self.order = walk.argsort()

    def _choose(self, lines: Float[Tensor, "m 4 3 k"]) -> Float[Tensor, "r 4 3 k"]:
        """Each chosen pixel as a view of its own, of one ray or of as many as a pixel has."""
        _, rows, columns = self.selection.domain_shape
        view, v, u = self.pixels.to(lines.device)
        if lines.shape[3] == 1:
            return lines[(view * rows + v) * columns + u]
        r = self.A.rays_per_pixel
        across, down, middle = (
            lines[view].unbind(dim=3) if r > 1 else (lines[..., k][view] for k in range(3))
        )
        u = r * (u - (columns - 1) / 2).to(lines)[:, None, None]
        v = r * (v - (rows - 1) / 2).to(lines)[:, None, None]
        centre = across * u + down * v + middle
        return torch.stack([across, down, centre], dim=3) if r > 1 else centre[..., None]

    def _walked(self, values: Float[Tensor, "b c r"]) -> Float[Tensor, "b c r"]:
        return values.new_zeros(values.shape).index_copy(2, self.order.to(values.device), values)

    def _sorted(self, values: Float[Tensor, "b c r"]) -> Float[Tensor, "b c r"]:
        return values.index_select(2, self.order.to(values.device))


class SomeViews(SomeRays):
    """Chosen cameras of a ray transform: volumes [b c d h w] to views [b c k v u], in the
    selection's order.
    """

    selection: ViewSelection

    def _prepare(self) -> None:
        rays = self.A.rays
        self.detector = (1, 1) if isinstance(rays, ExplicitRays) else rays.shape

    def _choose(self, lines: Float[Tensor, "m 4 3 k"]) -> Float[Tensor, "n 4 3 k"]:
        count = self.selection.domain_shape[0]
        return lines.unflatten(0, (count, -1))[self.selection.places].flatten(0, 1)


class RayTransform(LineIntegrals):
    """y = A x: the integrals of volumes along the rays of a rig, in (unit of x) * mm.

    Differentiable in the volume, in the views of the adjoint, and in the cameras' tensors; second
    derivatives in these are the reference's.
    Half and bfloat16 volumes are read as they are and summed in float32, which views and adjoints
    are given back in. Geometry stays in float64 whatever the module is cast to. Grid and cameras
    stay where they were made; `.to(device)` moves the operator. Cameras that want a gradient are
    followed wherever they move; others must stay as they were when it was built. `last_backend`
    tells which back end did the last call, `skipped` what it left out.

    Args:
        grid: where the voxels lie.
        cameras: the rig, or rays given one by one.
        method: "joseph", second order in the voxel size for smooth volumes, first across sharp
            edges, with a step where a ray's main axis changes; "siddon", exact for volumes of
            constant voxels, first order otherwise; or "trilinear", second order in the distance of
            its samples too, and dearer than "joseph" at no gain. It has as many samples on each ray
            as voxels fit along the grid's diagonal; "trilinear:300" has 300.
        backend: "cpu" (compiled), "cuda" (compiled), "reference" (torch, any device and order of
            derivative), or "auto": the compiled one of the tensors' device where it can be had,
            else reference.
        rays_per_pixel: a pixel is the mean over so many rays each way (1: the thin ray at its
            centre).
        skip: what `forward` leaves out of a volume: "off", nothing; "box", what lies outside the
            box of its voxels that are not zero; "brick", its empty bricks of 8 voxels a side, too;
            "auto", what costs least. The volume is looked at in every call, and the views are the
            same to the last bit. "verify" also goes without skipping, and raises where a bit
            differs. Its gradient by the volume stays dense.
        support: the voxels that may be anything but zero, a mask [d h w]. It is part of the
            operator, A diag(support), and of its adjoint, diag(support) A^T; what lies outside of
            it is neither read nor written.

    Raises:
        ValueError: an unknown method, back end or way to skip, counts below one, or a support that
            does not fit.
    """

    capabilities = frozenset({"subset", "crop", "support", "refine"})

    def __init_subclass__(cls, **options: object) -> None:
        """A subclass that computes something else has the whole operator's parts alone: right, but
        nothing is saved.
        """
        super().__init_subclass__(**options)
        if {"forward", "adjoint"} & vars(cls).keys():
            cls.capabilities = frozenset()

    def subset(self, selection: LinearOperator) -> LinearOperator:
        """The rays of some views or pixels alone."""
        if "subset" in self.capabilities and isinstance(selection, ViewSelection):
            return SomeViews(self, selection)
        if "subset" in self.capabilities and isinstance(selection, RaySelection):
            return SomePixels(self, selection)
        return super().subset(selection)

    def cropped(self, box: Box, views: Sequence[int] | None = None) -> Projector:
        """The same for the voxels of a box and for some cameras, with the same options.

        Raises:
            ValueError: as `cameras`.
        """
        if "crop" not in self.capabilities:
            return super().cropped(box, views)
        support = None if self.support is None else self.support[box.slices].cpu()
        rig = self.cameras
        cameras = rig if views is None else rig[torch.tensor(views, device=rig.source.device)]
        return self._like(self.grid.cropped(box), cameras, support, self.rays_per_pixel)

    def refined(self, factor: int) -> Projector:
        """The same on a finer grid, with the same options, and rays as much closer.

        Raises:
            ValueError: explicit rays, which stand for no pixels, or a subclass that computes
                something else.
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
        need not keep to, and for explicit rays.
        """
        if self.support is not None or isinstance(self.rays, ExplicitRays):
            return None
        return PixelIntegral.plain(self.rays_per_pixel)

    def mirror(self) -> Mirror | None:
        """A plane that mirrors grid, rig and support into themselves."""
        # a ray in the face between two voxels is given to one of them by "siddon": not to that
        # one's mirror image
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
            return super().with_support(check_support(support, self.grid))
        other = copy(self)
        other._buffers = dict(self._buffers)
        moved = check_support(support, self.grid)
        other.support = None if moved is None else moved.to(self.fixed_lines.device)
        other._support_code, other._support_box = other._occupied_by_support()
        other._last = None
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
        """Volumes from views: every value spread along its ray with the weights of `forward`; zeros
        cost nothing.

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
