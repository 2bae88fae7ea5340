"""Cells of pixels or voxels as channels: half the resolution without a loss of information."""

from collections.abc import Sequence

from jaxtyping import Shaped
from torch import Tensor
from torch.nn.functional import pad


def to_cells(x: Shaped[Tensor, "n c *d"], edge: int) -> Shaped[Tensor, "n k *e"]:
    """Images or volumes as cells of `edge` pixels along each axis, whose values are channels.

    Args:
        x: of sizes that `edge` divides.
        edge: of a cell, in pixels or voxels.
    """
    if edge == 1:
        return x
    n, c, *sizes = x.shape
    axes = len(sizes)
    split = x.reshape(n, c, *(part for size in sizes for part in (size // edge, edge)))
    outer, inner = range(2, 2 + 2 * axes, 2), range(3, 3 + 2 * axes, 2)
    return split.permute(0, 1, *inner, *outer).flatten(1, 1 + axes)


def from_cells(x: Shaped[Tensor, "n k *e"], edge: int) -> Shaped[Tensor, "n c *d"]:
    """Images or volumes of the cells that `to_cells` makes."""
    if edge == 1:
        return x
    n, k, *sizes = x.shape
    axes = len(sizes)
    split = x.reshape(n, k // edge**axes, *[edge] * axes, *sizes)
    order = [axis for i in range(axes) for axis in (2 + axes + i, 2 + i)]
    return split.permute(0, 1, *order).reshape(n, -1, *(size * edge for size in sizes))


def padded(x: Shaped[Tensor, "n c *d"], multiple: int) -> Shaped[Tensor, "n c *e"]:
    """Images or volumes with zeros behind, up to sizes that `multiple` divides."""
    behind = [-size % multiple for size in reversed(x.shape[2:])]
    return pad(x, [amount for axis in behind for amount in (0, axis)]) if any(behind) else x


def trimmed(x: Shaped[Tensor, "n c *e"], sizes: Sequence[int]) -> Shaped[Tensor, "n c *d"]:
    """The first pixels or voxels of each axis; undoes `padded`."""
    for axis, size in enumerate(sizes, start=2):
        if x.shape[axis] > size:
            x = x.narrow(axis, 0, size)
    return x
