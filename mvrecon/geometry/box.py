"""Boxes of voxels: the least box around the non-zero voxels of a volume, crops and pastes by it.

Convention: bounds are in the order of the tensor's axes (z, y, x), the upper ones one behind the
last voxel.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property

import torch
from jaxtyping import Bool, Int, Shaped
from torch import Tensor

Three = tuple[int, int, int]


@dataclass(frozen=True)
class Box:
    """The voxels with low <= index < high along (z, y, x); empty where a bound meets the other.

    Args:
        low: first voxel along each axis.
        high: one behind the last.
    """

    low: Three
    high: Three

    @classmethod
    def whole(cls, shape: Sequence[int]) -> "Box":
        """All of a volume of `shape` (z, y, x)."""
        return cls((0, 0, 0), three(shape))

    @classmethod
    def around(cls, mask: Bool[Tensor, "*n d h w"]) -> "Box":
        """The least box that holds every true voxel of any of the masks; empty for none."""
        mask = mask.flatten(0, -4).any(dim=0) if mask.ndim > 3 else mask
        return cls.of(bounds(mask[None])[0].tolist())

    @classmethod
    def of(cls, numbers: Sequence[int]) -> "Box":
        """The box of a row of `bounds`."""
        return cls(three(numbers[:3]), three(numbers[3:]))

    @cached_property
    def shape(self) -> Three:
        """Voxels along (z, y, x)."""
        return three([max(0, high - low) for low, high in zip(self.low, self.high, strict=True)])

    @property
    def size(self) -> int:
        """How many voxels it holds."""
        d, h, w = self.shape
        return d * h * w

    @property
    def slices(self) -> tuple[slice, slice, slice]:
        """What cuts it out of the last three axes of a volume: `volume[..., *box.slices]`."""
        z, y, x = (slice(low, high) for low, high in zip(self.low, self.high, strict=True))
        return z, y, x

    def grown(self, voxels: int, shape: Sequence[int]) -> "Box":
        """With so many voxels more on every side, as far as a volume of `shape` goes; an empty box
        stays empty.
        """
        if not self.size:
            return self
        low = [max(0, bound - voxels) for bound in self.low]
        high = [min(int(n), bound + voxels) for bound, n in zip(self.high, shape, strict=True)]
        return Box(three(low), three(high))

    def aligned(self, multiple: int, shape: Sequence[int]) -> "Box":
        """Grown to bounds that are multiples of a number, or the volume's own."""
        low = [bound - bound % multiple for bound in self.low]
        high = [
            min(int(n), bound + -bound % multiple)
            for bound, n in zip(self.high, shape, strict=True)
        ]
        return Box(three(low), three(high))


def bounds(masks: Bool[Tensor, "b d h w"]) -> Int[Tensor, "b 6"]:
    """The least boxes around masks, each as its `low` and `high`, on the masks' device; zeros for
    none.
    """
    columns = masks.any(dim=3)
    lines = columns.any(dim=2), columns.any(dim=1), masks.any(dim=1).any(dim=1)
    low = [line.int().argmax(dim=1) for line in lines]  # the first of the greatest
    high = [line.shape[1] - line.flip(1).int().argmax(dim=1) for line in lines]
    return torch.stack(low + high, dim=1) * lines[0].any(dim=1, keepdim=True)


def filled(bounds: Int[Tensor, "b 6"], shape: Sequence[int]) -> Bool[Tensor, "b d h w"]:
    """Masks of the voxels in boxes, from their rows of `bounds`, on the bounds' device."""
    inside = bounds.new_ones((len(bounds), 1, 1, 1), dtype=torch.bool)
    for axis, size in enumerate(shape):
        place = torch.arange(size, device=bounds.device)
        low, high = bounds[:, axis, None], bounds[:, axis + 3, None]
        sizes = [-1, *(size if other == axis else 1 for other in range(3))]
        inside = inside & ((place >= low) & (place < high)).view(sizes)
    return inside


def placed(
    part: Shaped[Tensor, "*b a e i"], box: Box, shape: Sequence[int]
) -> Shaped[Tensor, "*b d h w"]:
    """The part of a volume of `shape` that lies in a box, with zeros around it."""
    ends = zip(box.low, box.high, shape, strict=True)
    around = [(low, int(n) - high) for low, high, n in ends]
    return torch.nn.functional.pad(part, [voxels for pair in reversed(around) for voxels in pair])


def bricks_along(shape: Sequence[int], edge: int) -> Three:
    """Bricks of an edge along (z, y, x) that fill a volume of `shape`; the last ones may be cut."""
    return three(-(-int(n) // edge) for n in shape)


def three(values: Iterable[int]) -> Three:
    """Three integers (z, y, x)."""
    d, h, w = (int(value) for value in values)
    return d, h, w
