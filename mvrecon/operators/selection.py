"""Parts of a ray transform: selections of cameras or pixels as operators on views, whose adjoint
fills in zeros; supports; and the report of skipped voxels.
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

from mvrecon.geometry.grid import Box
from mvrecon.kernels.operator import to_accumulation_dtype
from mvrecon.kernels.rays.occupancy import Occupancy
from mvrecon.operators.checks import check_floating
from mvrecon.operators.operator import Derived, LinearOperator


class ViewSelection(LinearOperator):
    """Selects views, [b c m v u] -> [b c k v u], in the given order.

    Args:
        shape: shape of all views, (m, v, u).
        views: their indices, without repetition.

    Raises:
        ValueError: an index out of range, or repeated.
    """

    def __init__(self, shape: Sequence[int], views: Sequence[int]):
        self.views, count = [int(view) for view in views], shape[0]
        if len(set(self.views)) < len(self.views) or not all(0 <= v < count for v in self.views):
            raise ValueError(f"Expected different views from 0 to {count - 1}, got {self.views}")
        self.domain_shape, self.range_shape = tuple(shape), (len(self.views), *shape[1:])
        self.places = _every(self.views)

    def forward(self, x: Float[Tensor, "b c m v u"]) -> Float[Tensor, "b c k v u"]:
        """Return the selected views."""
        return x[:, :, self.places].contiguous()

    def adjoint(self, y: Float[Tensor, "b c k v u"]) -> Float[Tensor, "b c m v u"]:
        """Return all views: the selected ones, and zeros."""
        zeros = y.new_zeros(*y.shape[:2], *self.domain_shape)
        if isinstance(self.places, slice):
            every = self.places
            return torch.slice_scatter(zeros, y, 2, every.start, every.stop, every.step)
        return zeros.index_copy(2, torch.tensor(self.places, device=y.device), y)


def _every(views: list[int]) -> slice | list[int]:
    """Evenly spaced views, such as ordered subsets, as a slice: a list would be copied to a GPU,
    which synchronises.
    """
    apart = views[1] - views[0] if len(views) > 1 else 1
    if not views or apart < 1 or views != list(range(views[0], views[-1] + 1, apart)):
        return views
    return slice(views[0], views[-1] + 1, apart)


class RaySelection(LinearOperator):
    """Selects pixels of views, [b c m v u] -> [b c r], in the order of `chosen.nonzero()`.

    Args:
        shape: shape of all views, (m, v, u).
        chosen: the pixels.

    Raises:
        ValueError: not a mask of that shape.
    """

    def __init__(self, shape: Sequence[int], chosen: Bool[Tensor, "m v u"]):
        if chosen.dtype != torch.bool or tuple(chosen.shape) != tuple(shape):
            got = f"{chosen.dtype} {tuple(chosen.shape)}"
            raise ValueError(f"Expected a mask [m v u] of sizes {tuple(shape)}, got {got}")
        self.chosen, self.index = chosen.clone(), chosen.flatten().nonzero()[:, 0]
        self.domain_shape, self.range_shape = tuple(shape), (len(self.index),)

    def forward(self, x: Float[Tensor, "b c m v u"]) -> Float[Tensor, "b c r"]:
        """Return the values of the selected pixels."""
        return x.flatten(2).index_select(2, self.index.to(x.device))

    def adjoint(self, y: Float[Tensor, "b c r"]) -> Float[Tensor, "b c m v u"]:
        """Return all views: the selected pixels' values, and zeros."""
        zeros = y.new_zeros(*y.shape[:2], self.chosen.numel())
        return zeros.index_copy(2, self.index.to(y.device), y).unflatten(2, self.domain_shape)


class SomeRays(Derived):
    """The selected views or pixels of a ray transform, volumes [b c d h w] to [b c k v u] or [b c
    r] in the selection's order, and the matched adjoint.

    Differentiable as the transform, also in the cameras' tensors, and on its device. Values equal
    the whole operator's up to rounding (another order of sums): to about 1e-6 of their norm in
    float32, 1e-12 in float64. Fixed rays are cached: 96 bytes for each view or pixel, 288 for a
    pixel of several rays.

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
            # column by column: consecutive rays mostly differ in z, and share cached voxels
            walk = ((view * columns + u) * rows + v).argsort()
            self.pixels = torch.stack([view, v, u]).index_select(1, walk)
            self.order, self.detector = walk.argsort(), [self.per_pixel] * 2
        self._fixed = None if A.pose_gradient else self._choose(A.lines)

    @property
    def lines(self) -> Float[Tensor, "n 4 3 k"]:
        """The rays in voxel space; recomputed, with a graph, if the cameras require a gradient."""
        lines = self.A.lines
        if self.A.pose_gradient or self._fixed is None:
            return self._choose(lines)
        return self._fixed.to(lines.device)

    def _choose(self, lines: Float[Tensor, "m 4 3 k"]) -> Float[Tensor, "n 4 3 k"]:
        """The selected views' lines, or each selected pixel as a view of its own, with the rays of
        a pixel.
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
        """Return the selected entries of A x.

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
        """Return volumes from the selected entries, with zeros for all others.

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
    """The operator of some cameras, volumes [b c d h w] to views [b c k v u]."""
    return A.subset(ViewSelection(A.range_shape, views))


def ray_subset(A: LinearOperator, chosen: Bool[Tensor, "m v u"]) -> LinearOperator:
    """The operator of some pixels, volumes [b c d h w] to values [b c r]."""
    return A.subset(RaySelection(A.range_shape, chosen))


def ordered_subsets(count: int, subsets: int) -> list[range]:
    """Return the indices of `count` cameras dealt to ordered subsets in turn, so that each covers
    all directions.

    Raises:
        ValueError: not a whole number from one to the number of cameras.
    """
    if not isinstance(subsets, Integral) or not 1 <= subsets <= count:
        raise ValueError(f"Expected 1 to {count} subsets of whole cameras, got {subsets!r}")
    return [range(first, count, subsets) for first in range(subsets)]


def distant_order(count: int) -> list[int]:
    """Return an order of `count` ordered subsets in which consecutive ones are far apart.

    The ranks of the multiples of the golden section of a turn (Kohler, IEEE Nucl. Sci. Symp. 2004).
    """
    golden = (math.sqrt(5) - 1) / 2
    order = [0] * count
    for rank, number in enumerate(sorted(range(count), key=lambda n: n * golden % 1)):
        order[number] = rank
    return order


def usual_subsets(count: int) -> int:
    """Return the default number of subsets, the square root of `count`: 6 of 32, 19 of 360."""
    return max(1, round(math.sqrt(count)))


SKIPS = ("auto", "off", "box", "brick", "verify")


@dataclass(frozen=True)
class Skipped:
    """Voxels that one call of an operator skipped.

    Args:
        mode: "off", "box" or "brick".
        box: voxels outside it are zero, or outside the support, and were not read.
        why: the reason for the mode, as a sentence.
        fractions: "voxels": share of the volume in the box; "box" and "brick": remaining share of
            the work with each, estimated from a few rays; absent if not estimated.
    """

    mode: str
    box: Box
    why: str
    fractions: Mapping[str, float] = field(default_factory=dict)


def skip_report(code: Tensor | None, skip: str, shape: Sequence[int]) -> Skipped:
    """Report a call from its occupancy code; None: nothing was skipped."""
    if code is None:
        return Skipped("off", Box.whole(shape), "skipping is off, or the back end does not skip")
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


def check_support(support: Tensor | None, shape: tuple[int, ...]) -> Bool[Tensor, "d h w"] | None:
    """Check the shape and dtype of a support.

    Raises:
        ValueError: not a mask of the volume's shape.
    """
    if support is not None and (support.dtype != torch.bool or support.shape != shape):
        raise ValueError(
            f"A support is a mask of bool with the volume's shape {shape}, "
            f"got {str(support.dtype).removeprefix('torch.')} of {tuple(support.shape)}"
        )
    return support


def within(
    volumes: Float[Tensor, "n d h w"], support: Bool[Tensor, "d h w"]
) -> Float[Tensor, "n d h w"]:
    """Set volumes to zero outside a support, including NaN and infinity."""
    return torch.where(support, volumes, 0)


def verify(views: Tensor, dense: Tensor, skipped: Skipped) -> None:
    """Raise RuntimeError unless views equal those without skipping, bit by bit."""
    same = (views == dense) | (views.isnan() & dense.isnan())
    if not same.all():
        raise RuntimeError(
            f"skip='verify': {int((~same).sum())} of {same.numel()} pixels differ from those "
            f"without skipping "
            f"({skipped.mode}, {skipped.why})"
        )
