"""Part of a ray transform: some views (ordered subsets) or some pixels, at a cost that falls with
their number.
"""

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import avg_pool2d

from mvrecon.cameras.explicit import ExplicitRays
from mvrecon.kernels.precision import wide
from mvrecon.projectors.checks import check_floating
from mvrecon.projectors.integrals import LineIntegrals
from mvrecon.projectors.operator import Derived, LinearOperator
from mvrecon.projectors.selection import RaySelection, ViewSelection


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
        rays = self._walked(wide(y)).reshape(n, len(lines), *self.detector)
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
