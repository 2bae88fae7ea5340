"""A volume that is read slab by slab, so that memory holds one slab and not the volume."""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

#: Voxels of a slab, unless one plane has more: 8 MiB in float32.
VOXELS = 2**21
Slab = tuple[int, Float[Tensor, "d h w"]]


@dataclass(frozen=True, eq=False)
class Slabs:
    """A volume [d h w], read anew at every pass.

    Args:
        shape: voxels along (z, y, x).
        axis: of the tensor, 0 to 2, along which the slabs follow each other, in any order.
        passes: begins a pass, which gives the first index along the axis and the values of every
            slab once.
    """

    shape: tuple[int, int, int]
    axis: int
    passes: Callable[[], Iterator[Slab]]

    @classmethod
    def of(cls, volume: Float[Tensor, "d h w"]) -> "Slabs":
        """A volume in memory, as one slab."""
        return cls(tuple(volume.shape), 0, lambda: iter([(0, volume)]))  # type: ignore[arg-type]

    def __iter__(self) -> Iterator[Slab]:
        return self.passes()

    def flipped(self, axes: list[int]) -> "Slabs":
        """The volume with some of its axes reversed."""
        n, turned = self.shape[self.axis], self.axis in axes

        def passes() -> Iterator[Slab]:
            for first, slab in self:
                yield (n - first - slab.shape[self.axis] if turned else first), slab.flip(axes)

        return replace(self, passes=passes)

    def mapped(self, change: Callable[[Float[Tensor, "d h w"]], Float[Tensor, "d h w"]]) -> "Slabs":
        """The volume with a function applied to every slab."""
        return replace(self, passes=lambda: ((first, change(slab)) for first, slab in self))

    def watched(self, check: Callable[[float, float], None]) -> "Slabs":
        """The volume whose least and greatest value a function gets at the end of every pass."""

        def passes() -> Iterator[Slab]:
            low, high = math.inf, -math.inf
            for first, slab in self:
                low, high = min(low, slab.min().item()), max(high, slab.max().item())
                yield first, slab
            check(low, high)

        return replace(self, passes=passes)

    def whole(self) -> Float[Tensor, "d h w"]:
        """The whole volume in memory."""
        values = torch.empty(self.shape)
        for first, slab in self:
            values.narrow(self.axis, first, slab.shape[self.axis]).copy_(slab)
        return values


def planes(plane: int) -> int:
    """Number of planes in a slab, for a number of voxels in one plane."""
    return max(1, VOXELS // plane)


def ends(line: Bool[Tensor, " n"]) -> tuple[int, int]:
    """Index of the first true value and index behind the last one; (0, 0) if none is true."""
    places = line.nonzero().flatten().tolist()
    return (places[0], places[-1] + 1) if places else (0, 0)
