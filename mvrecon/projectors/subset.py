"""Some of a projector's rays, at a cost that falls with their number: bins with counts, ordered subsets of cameras."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import avg_pool2d

from mvrecon.cameras.explicit import ExplicitRays
from mvrecon.kernels.backends import wide
from mvrecon.projectors.base import Projector, check_floating


class Subset(ABC):
    """Some rows of a projector: the chosen entries of A x, and the matched adjoint of what chooses them.

    Differentiable as the projector is, in the cameras' tensors too, and on the device where the projector is. The
    values are the whole operator's up to rounding, since sums may be taken in another order: to about 1e-6 of their
    norm in float32, 1e-12 in float64. A projector that does more than to integrate along its lines is computed whole:
    right, but nothing is saved; `alone` tells.
    """

    #: Of the values for one volume, behind batch and channel.
    shape: tuple[int, ...]
    #: Pixels (rows, columns) of each of the views that `lines` describes.
    detector: tuple[int, int]

    def __init__(self, A: Projector):
        self.A, self.grid = A, A.grid
        self.alone = type(A).forward is Projector.forward and type(A).adjoint is Projector.adjoint
        self._fixed = None if A.poses else self._choose(A.lines)

    @abstractmethod
    def _choose(self, lines: Float[Tensor, "m 4 3 k"]) -> Float[Tensor, "n 4 3 k"]: ...

    @abstractmethod
    def pick(self, views: Float[Tensor, "b c m v u"]) -> Float[Tensor, "b c *shape"]:
        """The entries of views that belong to the subset."""

    @abstractmethod
    def place(self, values: Float[Tensor, "b c *shape"]) -> Float[Tensor, "b c m v u"]:
        """Views with these entries, zero elsewhere: the transpose of `pick`."""

    @property
    def lines(self) -> Float[Tensor, "n 4 3 k"]:
        """The rays in voxel space; made anew, with their graph, where the cameras want a gradient."""
        lines = self.A.lines
        return self._choose(lines) if self.A.poses or self._fixed is None else self._fixed.to(lines.device)

    def __call__(self, volume: Float[Tensor, "b c d h w"]) -> Float[Tensor, "b c *shape"]:
        """The chosen entries of A x.

        Raises:
            ValueError: a wrong rank, size or device.
        """
        if not self.alone:
            return self.pick(self.A(volume))
        r = self.A.rays_per_pixel
        rays = self.A.project_along(volume, self.lines, [n * r for n in self.detector])
        # as a batch, which may be empty
        rays = avg_pool2d(rays.flatten(0, 1)[:, None], r) if r > 1 else rays
        return self._sorted(rays.reshape(*volume.shape[:2], *self.shape))

    @property
    def T(self) -> Callable[[Float[Tensor, "b c *shape"]], Float[Tensor, "b c d h w"]]:
        """The matched adjoint: volumes from the chosen entries alone."""
        return self.adjoint

    def adjoint(self, values: Float[Tensor, "b c *shape"]) -> Float[Tensor, "b c d h w"]:
        """Volumes from the chosen entries, as if all others were zero.

        Raises:
            ValueError: a wrong rank, size or dtype.
        """
        if values.ndim != 2 + len(self.shape) or tuple(values.shape[2:]) != self.shape:
            raise ValueError(f"Expected values [b c ..] with last sizes {self.shape}, got {tuple(values.shape)}")
        check_floating(values, "values")
        if not self.alone:
            return self.A.T(self.place(values))
        lines, r = self.lines, self.A.rays_per_pixel
        y = self._walked(wide(values)).reshape(values.shape[0] * values.shape[1], len(lines), *self.detector)
        if r > 1:
            y = (y / r**2).repeat_interleave(r, dim=2).repeat_interleave(r, dim=3)
        return self.A.backproject_along(y, lines).unflatten(0, values.shape[:2])

    def _walked(self, values: Float[Tensor, "b c *shape"]) -> Float[Tensor, "b c *shape"]:
        """Values in the order of `lines`."""
        return values

    def _sorted(self, values: Float[Tensor, "b c *shape"]) -> Float[Tensor, "b c *shape"]:
        """The inverse of `_walked`."""
        return values


class RaySubset(Subset):
    """Chosen pixels of a projector: volumes [b c d h w] to [b c r], in the order of `chosen.nonzero()`.

    Fixed rays are kept: 96 bytes each, 288 where a pixel has several.

    Args:
        A: the projector.
        chosen: which pixels of which views.

    Raises:
        ValueError: no mask of the size of the projector's views.
    """

    def __init__(self, A: Projector, chosen: Bool[Tensor, "m v u"]):
        sizes = (len(A.rays), *A.rays.shape)
        if chosen.dtype != torch.bool or tuple(chosen.shape) != sizes:
            raise ValueError(f"Expected a mask [m v u] of sizes {sizes}, got {chosen.dtype} {tuple(chosen.shape)}")
        here = chosen.to(A.fixed_lines.device)
        # column by column: rays in turn mostly differ in z, and meet again the voxels that the cache holds
        view, u, v = here.mT.nonzero().unbind(dim=1)
        self.pixels = torch.stack([view, v, u])
        flat = (view * sizes[1] + v) * sizes[2] + u
        self.index, self.order = flat.sort()
        self.sizes, self.shape, self.detector = sizes, (len(flat),), (1, 1)
        super().__init__(A)

    def _choose(self, lines: Float[Tensor, "m 4 3 k"]) -> Float[Tensor, "r 4 3 k"]:
        """Each chosen pixel as a view of its own, of one ray or of as many as a pixel has."""
        view, v, u = self.pixels.to(lines.device)
        if lines.shape[3] == 1:
            return lines[(view * self.sizes[1] + v) * self.sizes[2] + u]
        r, (_, rows, columns) = self.A.rays_per_pixel, self.sizes
        across, down, middle = lines[view].unbind(dim=3) if r > 1 else (lines[..., k][view] for k in range(3))
        u, v = (r * (n - (size - 1) / 2).to(lines)[:, None, None] for n, size in ((u, columns), (v, rows)))
        here = across * u + down * v + middle
        return torch.stack([across, down, here], dim=3) if r > 1 else here[..., None]

    def _walked(self, values: Float[Tensor, "b c r"]) -> Float[Tensor, "b c r"]:
        return values.new_zeros(values.shape).index_copy(2, self.order.to(values.device), values)

    def _sorted(self, values: Float[Tensor, "b c r"]) -> Float[Tensor, "b c r"]:
        return values.index_select(2, self.order.to(values.device))

    def pick(self, views: Float[Tensor, "b c m v u"]) -> Float[Tensor, "b c r"]:
        """The entries of views at the chosen pixels."""
        return views.flatten(2).index_select(2, self.index.to(views.device))

    def place(self, values: Float[Tensor, "b c r"]) -> Float[Tensor, "b c m v u"]:
        """Views with these values at the chosen pixels, zero elsewhere."""
        m, v, u = self.sizes
        empty = values.new_zeros(*values.shape[:2], m * v * u)
        return empty.index_copy(2, self.index.to(values.device), values).unflatten(2, self.sizes)


class ViewSubset(Subset):
    """Chosen cameras of a projector: volumes [b c d h w] to views [b c k v u], in the given order.

    Args:
        A: the projector.
        views: indices of its views, each once.

    Raises:
        ValueError: an index that no view has, or one given twice.
    """

    def __init__(self, A: Projector, views: Sequence[int]):
        self.views = [int(view) for view in views]
        count = len(A.rays)
        if len(set(self.views)) < len(self.views) or not all(0 <= view < count for view in self.views):
            raise ValueError(f"Expected different views from 0 to {count - 1}, got {self.views}")
        self.count, self.shape = count, (len(self.views), *A.rays.shape)
        self.detector = (1, 1) if isinstance(A.rays, ExplicitRays) else A.rays.shape
        super().__init__(A)

    def _choose(self, lines: Float[Tensor, "m 4 3 k"]) -> Float[Tensor, "n 4 3 k"]:
        return lines.unflatten(0, (self.count, -1))[self.views].flatten(0, 1)

    def pick(self, views: Float[Tensor, "b c m v u"]) -> Float[Tensor, "b c k v u"]:
        """The chosen views."""
        return views[:, :, self.views]

    def place(self, values: Float[Tensor, "b c k v u"]) -> Float[Tensor, "b c m v u"]:
        """All views: the chosen ones, and zeros."""
        every = values.new_zeros(*values.shape[:2], self.count, *values.shape[3:])
        return every.index_copy(2, torch.tensor(self.views, device=values.device), values)


def ordered_subsets(A: Projector, count: int) -> list[ViewSubset]:
    """The projector's cameras dealt out to `count` subsets in turn, so that each sees the object from all around.

    Raises:
        ValueError: fewer than one subset, or more than there are cameras.
    """
    if not 1 <= count <= len(A.rays):
        raise ValueError(f"Cameras are dealt out to 1 to {len(A.rays)} subsets, one camera each at least, got {count}")
    return [ViewSubset(A, range(first, len(A.rays), count)) for first in range(count)]
