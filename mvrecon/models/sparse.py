"""A U-Net's steps on a mask's voxels alone (sparse convolutions): nothing outside counts, nothing
outside is computed.

Features are rows [k c], one for each voxel. Every step is a gather of rows and dense arithmetic on
what it gives; an index that is one too large stands for a voxel that is not in the mask, whose
features are zero. Normalisation, halving and doubling average over the mask alone, so results do
not depend on how much empty space lies around it, as long as coarse voxels keep their places, and a
mask of ones gives the plain steps.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int, Shaped
from torch import Tensor

#: Voxels (z, y, x) of the bricks that convolutions are done in, all as one batch, each with a halo
#: of one voxel. Measured on one core with 8 to 32 channels (oneDNN, AVX2): 1.1 to 1.3 times the
#: time of dense convolutions per voxel, and small enough to follow a hull.
BRICK = (4, 4, 8)


@dataclass(frozen=True, eq=False)
class Voxels:
    """The voxels of n masks, in an order in which those of a sample, and of a brick, follow each
    other.

    Args:
        shape: (n, d, h, w).
        counts: voxels of each sample.
        place: [k] where each lies in the flat volumes [n d h w].
        row: [n d+2 h+2 w+2] the row of each voxel, and of those around the volume; k outside the
            mask.
        around: [q 6 6 10] the rows of each brick and its halo.
        own: [k] where each voxel lies among those of the bricks.
    """

    shape: tuple[int, int, int, int]
    counts: list[int]
    place: Int[Tensor, " k"]
    row: Int[Tensor, "n z y x"]
    around: Int[Tensor, "q a e i"]
    own: Int[Tensor, " k"]

    @property
    def mask(self) -> Bool[Tensor, "n 1 d h w"]:
        """Where they are."""
        d, h, w = self.shape[1:]
        return self.row[:, None, 1 : d + 1, 1 : h + 1, 1 : w + 1] < len(self.place)

    def pick(self, volumes: Float[Tensor, "n c d h w"]) -> Float[Tensor, "k c"]:
        """The voxels' values."""
        return (
            volumes.permute(0, 2, 3, 4, 1).reshape(-1, volumes.shape[1]).index_select(0, self.place)
        )

    def put(self, rows: Float[Tensor, "k c"]) -> Float[Tensor, "n c d h w"]:
        """Volumes with the voxels' values, and zero elsewhere."""
        n, d, h, w = self.shape
        flat = rows.new_zeros(n * d * h * w, rows.shape[1]).index_copy(0, self.place, rows)
        return flat.view(n, d, h, w, -1).permute(0, 4, 1, 2, 3)


def voxels_of(mask: Bool[Tensor, "n 1 d h w"]) -> Voxels:
    """The voxels in which masks are true."""
    return pyramid(mask, 1)[0]


def _voxels(mask: Bool[Tensor, "n 1 d h w"], n_bricks: int, counts: list[int]) -> Voxels:
    """The voxels in which masks are true, whose numbers and that of their bricks are known."""
    n, _, d, h, w = mask.shape
    bricks = _bricks(_padded(mask), 0)
    active = _places_in(bricks.flatten(4).any(dim=-1), n_bricks)  # [q 4]
    voxels = bricks[tuple(active.unbind(dim=1))].flatten(1)  # [q 128]
    brick, inner = _places_in(voxels, sum(counts)).unbind(dim=1)
    sample, *corner = active[brick].unbind(dim=1)
    steps = zip(corner, BRICK, places_of(inner, BRICK), strict=True)
    z, y, x = (first * edge + step for first, edge, step in steps)
    outer = [count * edge + 2 for count, edge in zip(bricks.shape[1:4], BRICK, strict=True)]
    row = torch.full((n, *outer), len(z), device=mask.device)
    row[sample, z + 1, y + 1, x + 1] = torch.arange(len(z), device=mask.device)
    return Voxels(
        shape=(n, d, h, w),
        counts=counts,
        place=((sample * d + z) * h + y) * w + x,
        row=row,
        around=_bricks(row, 2)[tuple(active.unbind(dim=1))],
        own=brick * voxels.shape[1] + inner,
    )


def places_of(index: Int[Tensor, " k"], shape: Sequence[int]) -> list[Int[Tensor, " k"]]:
    """The index along each axis of a flat one; `torch.unravel_index` copies the shape to a GPU, and
    waits.
    """
    places = []
    for size in reversed(shape):
        places.append(index % size)
        index = index // size
    return places[::-1]


def _bricks(volumes: Shaped[Tensor, "n d h w"], more: int) -> Shaped[Tensor, "n z y x a e i"]:
    """Windows as large as bricks, or by so many voxels larger, at every brick."""
    for axis, edge in enumerate(BRICK, start=1):
        volumes = volumes.unfold(axis, edge + more, edge)
    return volumes


def _padded(mask: Bool[Tensor, "n 1 d h w"]) -> Bool[Tensor, "n e i x"]:
    """Masks of whole bricks."""
    d, h, w = (-size % edge for size, edge in zip(mask.shape[2:], BRICK, strict=True))
    return F.pad(mask[:, 0], (0, w, 0, h, 0, d))


def _places_in(mask: Bool[Tensor, "*n"], count: int) -> Int[Tensor, "k axes"]:
    """Where a mask is true, in so many places; where that is known, a GPU is not waited for."""
    return torch.nonzero_static(mask, size=count) if mask.is_cuda else mask.nonzero()


def pyramid(mask: Bool[Tensor, "n 1 d h w"], levels: int) -> list[Voxels]:
    """The voxels of a mask, and of it max-pooled by 2, 4, ...; their numbers are read at once, for
    each of which the host would wait for a GPU.
    """
    masks = [mask]
    for _ in range(1, levels):
        masks.append(F.max_pool3d(masks[-1].float(), 2, ceil_mode=True) > 0)
    bricks = (_bricks(_padded(one), 0).flatten(4).any(dim=-1).sum().view(1) for one in masks)
    sizes = [
        torch.cat([q, one.flatten(1).sum(dim=1)]) for q, one in zip(bricks, masks, strict=True)
    ]
    numbers = torch.stack(sizes).tolist()
    return [_voxels(one, q, counts) for one, (q, *counts) in zip(masks, numbers, strict=True)]


def convolved(
    x: Float[Tensor, "k i"], weight: Float[Tensor, "o i 3 3 3"], on: Voxels
) -> Float[Tensor, "k o"]:
    """A 3x3x3 convolution without bias."""
    bricks = _with_none(x).index_select(0, on.around.flatten()).view(*on.around.shape, x.shape[1])
    values = F.conv3d(bricks.permute(0, 4, 1, 2, 3), weight)  # channels last: rows are copied whole
    return values.permute(0, 2, 3, 4, 1).reshape(-1, len(weight)).index_select(0, on.own)


def group_norm(
    x: Float[Tensor, "k c"],
    counts: Sequence[int],
    groups: int,
    affine: tuple[Tensor, Tensor],
    eps: float = 1e-5,
) -> Float[Tensor, "k c"]:
    """Group normalisation (Wu & He, ECCV 2018) by the statistics of each sample's voxels.

    In two passes, mean first, so that an offset costs the variance no digits.

    Args:
        x: features.
        counts: rows of each sample.
        groups: of channels.
        affine: scale and shift of every channel.
        eps: added to the variance.
    """

    def mean(rows: Tensor) -> Tensor:
        means = rows.sum(dim=0).view(groups, -1).sum(dim=1, keepdim=True) / max(
            1, rows.numel() // groups
        )
        return means.expand(-1, rows.shape[1] // groups).reshape(-1)

    scale, shift = affine
    parts = []
    for part in x.split(list(counts)):
        about = part - mean(part)
        parts.append(torch.addcmul(shift, about, scale * (mean(about.square()) + eps).rsqrt()))
    return torch.cat(parts)


def halved(x: Float[Tensor, "k c"], fine: Voxels, coarse: Voxels) -> Float[Tensor, "l c"]:
    """Means of 2x2x2 voxels over those in the mask."""
    n, d, h, w = coarse.shape
    inner = fine.row[:, 1 : 1 + 2 * d, 1 : 1 + 2 * h, 1 : 1 + 2 * w]
    eighths = inner.reshape(n, d, 2, h, 2, w, 2).permute(0, 1, 3, 5, 2, 4, 6).reshape(-1, 8)
    return _means(x, eighths.index_select(0, coarse.place), x.new_ones(8))


def doubled(x: Float[Tensor, "l c"], coarse: Voxels, fine: Voxels) -> Float[Tensor, "k c"]:
    """Trilinear interpolation between the coarse voxels that are in the mask."""
    sample, *places = places_of(fine.place, fine.shape)
    first, side = (
        sample,
        torch.zeros_like(sample),
    )  # of the eight around a voxel; where it lies between them
    for place, size in zip(places, coarse.row.shape[1:], strict=True):
        first, side = first * size + (place + 1) // 2, side * 2 + place % 2
    sides = places_of(torch.arange(8, device=x.device), (2, 2, 2))
    corners = torch.stack(sides, dim=1)
    steps = sum(one * stride for one, stride in zip(sides, coarse.row.stride()[1:], strict=True))
    near = coarse.row.flatten().index_select(0, (first[:, None] + steps).flatten()).view(-1, 8)
    shares = (
        torch.where(corners[:, None] == corners, 0.25, 0.75).prod(dim=-1).to(x)
    )  # an even voxel is nearer to the
    return _means(x, near, shares.index_select(0, side))  # second of two, an odd one to the first


def _means(
    x: Float[Tensor, "k c"], rows: Int[Tensor, "l e"], weights: Float[Tensor, "*l e"]
) -> Float[Tensor, "l c"]:
    """Weighted means over the rows that there are."""
    shares = weights * (rows < len(x))
    shares = shares / shares.sum(dim=1, keepdim=True)
    return F.embedding_bag(rows, _with_none(x), per_sample_weights=shares, mode="sum")


def _with_none(x: Float[Tensor, "k c"]) -> Float[Tensor, "k+1 c"]:
    return torch.cat([x, x.new_zeros(1, x.shape[1])])
