"""What a ray transform leaves out: selection of cameras or pixels as operators on views, whose
adjoint puts the chosen values back among zeros, the support that is part of an operator, and the
report of what a call skipped.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from numbers import Integral
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import avg_pool2d

from mvrecon.geometry.grid import Box, Grid
from mvrecon.kernels.operator import to_accumulation_dtype
from mvrecon.kernels.rays.occupancy import Occupancy
from mvrecon.operators.operator import Derived, LinearOperator, check_floating


class ViewSelection(LinearOperator):
    """Chosen views, [b c m v u] -> [b c k v u], in the order in which they are named.

    Args:
        shape: of all views, (m, v, u).
        views: their indices, none of them twice.

    Raises:
        ValueError: an index that no view has, or one that comes twice.
    """

    def __init__(self, shape: Sequence[int], views: Sequence[int]):
        self.views, count = [int(view) for view in views], shape[0]
        if len(set(self.views)) < len(self.views) or not all(0 <= v < count for v in self.views):
            raise ValueError(f"Expected different views from 0 to {count - 1}, got {self.views}")
        self.domain_shape, self.range_shape = tuple(shape), (len(self.views), *shape[1:])
        self.places = _every(self.views)

    def forward(self, x: Float[Tensor, "b c m v u"]) -> Float[Tensor, "b c k v u"]:
        """The chosen views."""
        return x[:, :, self.places].contiguous()

    def adjoint(self, y: Float[Tensor, "b c k v u"]) -> Float[Tensor, "b c m v u"]:
        """All views: the chosen ones, and zeros."""
        zeros = y.new_zeros(*y.shape[:2], *self.domain_shape)
        if isinstance(self.places, slice):
            every = self.places
            return torch.slice_scatter(zeros, y, 2, every.start, every.stop, every.step)
        return zeros.index_copy(2, torch.tensor(self.places, device=y.device), y)


def _every(views: list[int]) -> slice | list[int]:
    """Views at one distance, such as ordered subsets, as a slice: a GPU is not waited for, as it is
    for a list that is copied there.
    """
    apart = views[1] - views[0] if len(views) > 1 else 1
    if not views or apart < 1 or views != list(range(views[0], views[-1] + 1, apart)):
        return views
    return slice(views[0], views[-1] + 1, apart)


class RaySelection(LinearOperator):
    """Chosen pixels of chosen views, [b c m v u] -> [b c r], in the order of `chosen.nonzero()`.

    Args:
        shape: of all views, (m, v, u).
        chosen: the pixels.

    Raises:
        ValueError: no mask of that shape.
    """

    def __init__(self, shape: Sequence[int], chosen: Bool[Tensor, "m v u"]):
        if chosen.dtype != torch.bool or tuple(chosen.shape) != tuple(shape):
            got = f"{chosen.dtype} {tuple(chosen.shape)}"
            raise ValueError(f"Expected a mask [m v u] of sizes {tuple(shape)}, got {got}")
        self.chosen, self.index = chosen, chosen.flatten().nonzero()[:, 0]
        self.domain_shape, self.range_shape = tuple(shape), (len(self.index),)

    def forward(self, x: Float[Tensor, "b c m v u"]) -> Float[Tensor, "b c r"]:
        """The values of the chosen pixels."""
        return x.flatten(2).index_select(2, self.index.to(x.device))

    def adjoint(self, y: Float[Tensor, "b c r"]) -> Float[Tensor, "b c m v u"]:
        """All views: the chosen pixels' values, and zeros."""
        zeros = y.new_zeros(*y.shape[:2], self.chosen.numel())
        return zeros.index_copy(2, self.index.to(y.device), y).unflatten(2, self.domain_shape)


class SomeRays(Derived):
    """The chosen views or pixels of a ray transform, volumes [b c d h w] to [b c k v u] or [b c r]
    in the selection's order, and the matched adjoint.

    Differentiable as the transform is, in the cameras' tensors too, and on its device. The values
    are the whole operator's up to rounding, since sums may be taken in another order: to about 1e-6
    of their norm in float32, 1e-12 in float64. Fixed rays are kept: 96 bytes for each view's or
    pixel's, 288 where a pixel has several.

    Args:
        A: the ray transform.
        selection: the views or pixels.
    """

    def __init__(self, A: Any, selection: ViewSelection | RaySelection):
        self.A, self.selection = A, selection
        self.domain_shape, self.range_shape = A.domain_shape, selection.range_shape
        #: Rays of a pixel, and pixels, each (rows, columns), of the views that `lines` describes.
        self.per_pixel, self.detector = A.rays_per_pixel, A.detector
        if isinstance(selection, RaySelection):
            _, rows, columns = selection.domain_shape
            index = selection.index.to(self.device)
            u, row = index % columns, index // columns
            view, v = row // rows, row % rows
            # column by column: rays in turn mostly differ in z, and meet again the voxels that the
            # cache holds
            walk = ((view * columns + u) * rows + v).argsort()
            self.pixels = torch.stack([view, v, u]).index_select(1, walk)
            self.order, self.detector = walk.argsort(), [self.per_pixel] * 2
        self._fixed = None if A.pose_gradient else self._choose(A.lines)

    @property
    def lines(self) -> Float[Tensor, "n 4 3 k"]:
        """The rays in voxel space; computed again, with a graph, if the cameras require a
        gradient.
        """
        lines = self.A.lines
        if self.A.pose_gradient or self._fixed is None:
            return self._choose(lines)
        return self._fixed.to(lines.device)

    def _choose(self, lines: Float[Tensor, "m 4 3 k"]) -> Float[Tensor, "n 4 3 k"]:
        """The chosen views' lines, or each chosen pixel as a view of its own, of one ray or of as
        many as a pixel has.
        """
        count, rows, columns = self.selection.domain_shape
        if isinstance(self.selection, ViewSelection):
            return lines.unflatten(0, (count, -1))[self.selection.places].flatten(0, 1)
        view, v, u = self.pixels.to(lines.device)
        if lines.shape[3] == 1:
            return lines[(view * rows + v) * columns + u]
        r = self.per_pixel
        across, down, middle = (
            lines[view].unbind(dim=3) if r > 1 else (lines[..., k][view] for k in range(3))
        )
        u = r * (u - (columns - 1) / 2).to(lines)[:, None, None]
        v = r * (v - (rows - 1) / 2).to(lines)[:, None, None]
        centre = across * u + down * v + middle
        return torch.stack([across, down, centre], dim=3) if r > 1 else centre[..., None]

    def forward(self, x: Float[Tensor, "b c d h w"]) -> Float[Tensor, "b c *n"]:
        """The chosen entries of A x.

        Raises:
            ValueError: a wrong rank, size or device.
        """
        r = self.per_pixel
        rays = self.A.project_along(x, self.lines, self.detector)
        # as a batch, which may be empty
        rays = avg_pool2d(rays.flatten(0, 1)[:, None], r) if r > 1 else rays
        values = rays.reshape(*x.shape[:2], *self.range_shape)
        if isinstance(self.selection, ViewSelection):
            return values
        return values.index_select(2, self.order.to(values.device))

    def adjoint(self, y: Float[Tensor, "b c *n"]) -> Float[Tensor, "b c d h w"]:
        """Volumes from the chosen entries, as if all others were zero.

        Raises:
            ValueError: a wrong rank, size or dtype.
        """
        if y.ndim != 2 + len(self.range_shape) or tuple(y.shape[2:]) != self.range_shape:
            expected = f"values [b c ..] with last sizes {self.range_shape}"
            raise ValueError(f"Expected {expected}, got {tuple(y.shape)}")
        check_floating(y, "values")
        lines, r, values = self.lines, self.per_pixel, to_accumulation_dtype(y)
        if isinstance(self.selection, RaySelection):
            order = self.order.to(values.device)
            values = values.new_zeros(values.shape).index_copy(2, order, values)
        pixels = [n // r for n in self.detector]
        rays = values.reshape(y.shape[0] * y.shape[1], len(lines), *pixels)
        if r > 1:
            rays = (rays / r**2).repeat_interleave(r, dim=2).repeat_interleave(r, dim=3)
        return self.A.backproject_along(rays, lines).unflatten(0, y.shape[:2])


def view_subset(A: LinearOperator, views: Sequence[int]) -> LinearOperator:
    """The part of an operator that makes some cameras' views, volumes [b c d h w] to views [b c k v
    u].
    """
    return A.subset(ViewSelection(A.range_shape, views))


def ray_subset(A: LinearOperator, chosen: Bool[Tensor, "m v u"]) -> LinearOperator:
    """The part of an operator that makes some pixels, volumes [b c d h w] to values [b c r]."""
    return A.subset(RaySelection(A.range_shape, chosen))


def ordered_subsets(count: int, subsets: int) -> list[range]:
    """The indices of `count` cameras dealt out in turn, so that each ordered subset sees the object
    from all around.

    Raises:
        ValueError: no whole number, fewer than one subset, or more than there are cameras.
    """
    if not isinstance(subsets, Integral) or not 1 <= subsets <= count:
        raise ValueError(
            f"Cameras are dealt out to 1 to {count} subsets, one camera each at least, got "
            f"{subsets!r}"
        )
    return [range(first, count, subsets) for first in range(subsets)]


def distant_order(count: int) -> list[int]:
    """An order of `count` ordered subsets in which one is far from those just before it.

    The ranks of the multiples of the golden section of a turn (Kohler, IEEE Nucl. Sci. Symp. 2004).
    """
    golden = (math.sqrt(5) - 1) / 2
    order = [0] * count
    for rank, number in enumerate(sorted(range(count), key=lambda n: n * golden % 1)):
        order[number] = rank
    return order


def usual_subsets(count: int) -> int:
    """A number of ordered subsets that suits `count` cameras, their square root: 6 of 32, 19 of
    360.
    """
    return max(1, round(math.sqrt(count)))


SKIPS = ("auto", "off", "box", "brick", "verify")


@dataclass(frozen=True)
class Skipped:
    """Voxels that one call of an operator skipped.

    Args:
        mode: "off", "box" or "brick".
        box: voxels outside it are zero, or outside the support, and were not read.
        why: the reason for the mode, as a sentence.
        fractions: "voxels": share of the volume in the box; "box" and "brick": share of the work
            that is left with each, counted on a few rays, absent if not counted.
    """

    mode: str
    box: Box
    why: str
    fractions: Mapping[str, float] = field(default_factory=dict)


def skip_report(code: Tensor | None, skip: str, shape: Sequence[int]) -> Skipped:
    """Report of a call by the code of its occupancy; None: nothing was skipped."""
    if code is None:
        return Skipped(
            "off",
            Box.whole(shape),
            "nothing was asked to be skipped, or the back end skips nothing",
        )
    occupancy = Occupancy.decoded(code)
    whole = occupancy.box == Box.whole(shape)
    mode = "brick" if occupancy.bricks is not None else "off" if whole else "box"
    fractions = {"voxels": occupancy.box.size / math.prod(shape)}
    fractions |= {
        name: share
        for name, share in zip(("box", "brick"), occupancy.shares, strict=True)
        if share == share
    }
    if "brick" in fractions:
        why = (
            f"on a few rays the box leaves {fractions['box']:.1%} of the work, bricks "
            f"{fractions['brick']:.1%}"
        )
        if mode != "brick" and fractions["brick"] < fractions["box"]:
            why += ", too little to gain by them"
    elif skip in ("box", "brick"):
        why = f"{skip!r} was asked for"
    else:
        why = (
            "it is small work, or the volume is full"
            if whole
            else "bricks are full, or too small work to count them"
        )
    return Skipped(mode, occupancy.box, why, fractions)


def check_support(support: Tensor | None, grid: Grid) -> Bool[Tensor, "d h w"] | None:
    """Check the shape and dtype of a support.

    Raises:
        ValueError: not a mask of the grid's shape.
    """
    if support is not None and (support.dtype != torch.bool or support.shape != grid.shape):
        raise ValueError(
            f"A support is a mask of bool with the grid's shape {grid.shape}, "
            f"got {str(support.dtype).removeprefix('torch.')} of {tuple(support.shape)}"
        )
    return support


def within(
    volumes: Float[Tensor, "n d h w"], support: Bool[Tensor, "d h w"]
) -> Float[Tensor, "n d h w"]:
    """Volumes set to zero outside a support, NaN and infinity included."""
    return torch.where(support, volumes, 0)


def verify(views: Tensor, dense: Tensor, skipped: Skipped) -> None:
    """Raise RuntimeError unless views are those without skipping, to the last bit."""
    same = (views == dense) | (views.isnan() & dense.isnan())
    if not same.all():
        raise RuntimeError(
            f"skip='verify': {int((~same).sum())} of {same.numel()} pixels differ from those "
            f"without skipping "
            f"({skipped.mode}, {skipped.why})"
        )
