"""Selection of cameras or pixels as operators: forward picks values of the views, the adjoint puts
them back among zeros.
"""

import math
from collections.abc import Sequence
from numbers import Integral

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from mvrecon.operators.operator import LinearOperator


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
