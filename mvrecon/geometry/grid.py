"""Voxel and pixel grids; and boxes of voxels: bounding boxes of non-zero voxels, crops and pastes.

Convention: a volume tensor is [b c d h w] = (z, y, x); points are (x, y, z) in mm. Voxel and pixel
indices are integer at centres: pixel (0, 0) is centred at (0, 0), so the principal point of W
columns is (W - 1) / 2. Bounds of a box are in the order of the tensor's axes (z, y, x), upper ones
exclusive.
"""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property

import torch
from jaxtyping import Bool, Float, Int, Shaped
from torch import Tensor

from mvrecon.core.machine import check_memory
from mvrecon.core.quantities import PositiveFloat, PositiveInt, Triple
from mvrecon.geometry.rigid import check_rotation


@dataclass(frozen=True, eq=False)
class Grid:
    """The positions of a volume's voxels.

    Args:
        shape: voxels along (z, y, x).
        affine: maps a voxel index (x, y, z, 1) to world mm, as in NIfTI; copied, float64, on the
            CPU.

    Raises:
        ValueError: an empty shape, or an affine that is not 4x4 and finite, left-handed or
            singular.

    Examples:
        >>> grid = mv.Grid.centred(size=(40, 40, 20), spacing=(1.0, 1.0, 2.5))
        >>> grid.size, grid.shape  # (x, y, z) and (z, y, x)
        ((40, 40, 20), (20, 40, 40))
        >>> grid.to_world(torch.zeros(3))  # the centre of the first voxel, in mm
        tensor([-19.5000, -19.5000, -23.7500])
    """

    shape: tuple[int, int, int]
    affine: Float[Tensor, "4 4"]

    def __post_init__(self) -> None:
        _check_shape(self.shape)
        affine = torch.as_tensor(self.affine, dtype=torch.float64).cpu().clone()
        if affine.shape != (4, 4) or not affine.isfinite().all():
            raise ValueError(f"A grid's affine must be a finite 4x4 matrix, got {self.affine}")
        volume = torch.linalg.det(affine[:3, :3] / affine[:3, :3].norm(dim=0)).item()
        if not volume > 1e-6:
            raise ValueError(
                f"A grid must be right-handed and not flat, got voxel axes with determinant "
                f"{volume:.3g}; "
                "flip the volume along one axis and its affine with it"
            )
        object.__setattr__(self, "shape", tuple(int(n) for n in self.shape))
        object.__setattr__(self, "affine", affine)

    @classmethod
    def centred(
        cls,
        n: PositiveInt | Triple[PositiveInt] | None = None,
        /,
        spacing: PositiveFloat | Triple[PositiveFloat] = math.nan,  # required
        centre: Triple[float] = (0.0, 0.0, 0.0),
        *,
        size: PositiveInt | Triple[PositiveInt] | None = None,
        shape: Triple[PositiveInt] | None = None,
    ) -> "Grid":
        """Build an axis-aligned grid about a point, all in the order (x, y, z)::

            Grid.centred(64, spacing=4.0)  # a cube is the same in either order
            Grid.centred(size=(96, 80, 40), spacing=(1.0, 1.0, 3.0))
            Grid.centred(shape=volume.shape, spacing=4.0)

        Args:
            n: voxels along every axis, 64 or (64, 64, 64).
            spacing: mm along (x, y, z), or one number for all.
            centre: world position of the grid's centre in mm (x, y, z).
            size: voxels along (x, y, z), or one number for all, instead of `n`.
            shape: voxels along (z, y, x), as a tensor's shape, instead of `n`; unequal sizes need
                an isotropic spacing.

        Raises:
            TypeError: none of `n`, `size` and `shape`, or several.
            ValueError: not three positive sizes, a spacing that is not positive and finite, a
                non-finite centre, sizes of ambiguous order, or a volume that does not fit into
                memory.
        """
        steps = torch.as_tensor(spacing, dtype=torch.float64).expand(3).clone()
        if not ((steps > 0) & steps.isfinite()).all():
            raise ValueError(f"A grid's spacing must be positive, finite mm, got {spacing}")
        middle = torch.as_tensor(centre, dtype=torch.float64)
        if not middle.isfinite().all():
            raise ValueError(f"A grid's centre must be finite mm, got {centre}")
        counts = _counts(n, size, shape, steps.tolist())
        _check_room(counts)
        affine = torch.diag(torch.cat([steps, steps.new_ones(1)]))
        affine[:3, 3] = middle - steps * (torch.tensor(counts[::-1], dtype=torch.float64) - 1) / 2
        return cls(counts, affine)

    @property
    def size(self) -> tuple[int, int, int]:
        """Voxels along (x, y, z)."""
        return self.shape[2], self.shape[1], self.shape[0]

    @property
    def spacing(self) -> tuple[float, float, float]:
        """Voxel size in mm along (x, y, z)."""
        return tuple(self.affine[:3, :3].norm(dim=0).tolist())  # type: ignore[return-value]

    @property
    def centre_index(self) -> Float[Tensor, "3"]:
        """The volume's centre as a voxel index (x, y, z)."""
        return (torch.tensor(self.shape[::-1], dtype=torch.float64) - 1) / 2

    @property
    def centre(self) -> Float[Tensor, "3"]:
        """The volume's centre in world mm."""
        return self.to_world(self.centre_index)

    def to_world(self, index: Float[Tensor, "*n 3"]) -> Float[Tensor, "*n 3"]:
        """World mm of voxel indices (x, y, z)."""
        affine = self.affine.to(index)
        return index @ affine[:3, :3].T + affine[:3, 3]

    def to_index(self, xyz: Float[Tensor, "*n 3"]) -> Float[Tensor, "*n 3"]:
        """Voxel indices (x, y, z) of world points in mm."""
        inverse = torch.linalg.inv(self.affine).to(xyz)
        return xyz @ inverse[:3, :3].T + inverse[:3, 3]

    def corners(self) -> Float[Tensor, "8 3"]:
        """World positions of the outer corners of the grid's box, in mm."""
        sizes = torch.tensor(self.shape[::-1], dtype=torch.float64)
        ends = torch.cartesian_prod(
            *[torch.tensor([-0.5, n - 0.5], dtype=torch.float64) for n in sizes.tolist()]
        )
        return self.to_world(ends)

    def moved(self, rotation: Float[Tensor, "3 3"], translation: Float[Tensor, "3"]) -> "Grid":
        """Apply the rigid motion X -> R X + t of the world, t in mm.

        Raises:
            ValueError: other shapes, R is not a rotation, or t is not finite.
        """
        R, t = rotation.to(self.affine), translation.to(self.affine)
        if R.shape != (3, 3) or t.shape != (3,):
            raise ValueError(
                f"A motion of a grid must be R [3 3] with t [3], got {list(R.shape)} and "
                f"{list(t.shape)}"
            )
        check_rotation(R)
        if not t.isfinite().all():
            raise ValueError(f"A translation must be finite mm, got {t.tolist()}")
        affine = self.affine.clone()
        affine[:3] = R @ affine[:3]
        affine[:3, 3] += t
        return Grid(self.shape, affine)

    def cropped(self, box: "Box") -> "Grid":
        """Crop to the voxels in a box.

        Raises:
            ValueError: a box that is empty or not inside the grid.
        """
        inside = all(
            0 <= low < high <= n for low, high, n in zip(box.low, box.high, self.shape, strict=True)
        )
        if not inside:
            raise ValueError(
                f"A grid of {self.shape} voxels cannot be cropped to {box.low} .. {box.high}"
            )
        affine = self.affine.clone()
        affine[:3, 3] = self.to_world(torch.tensor(box.low[::-1], dtype=torch.float64))
        return Grid(box.shape, affine)

    def resized(self, size: Sequence[int]) -> "Grid":
        """The grid of `size` voxels along (x, y, z) with the same centre and voxels."""
        less = [(n - other) / 2 for n, other in zip(self.size, size, strict=True)]
        affine = self.affine.clone()
        affine[:3, 3] = self.to_world(affine.new_tensor(less))
        return Grid((size[2], size[1], size[0]), affine)

    def refined(self, factor: int) -> "Grid":
        """Split the box into `factor` times as many voxels along each axis.

        Raises:
            ValueError: the volume does not fit into memory.
        """
        shape = tuple(n * factor for n in self.shape)
        _check_room(shape)
        affine = self.affine.clone()
        affine[:3, :3] /= factor
        first = torch.full((3,), (1 - factor) / (2 * factor), dtype=torch.float64)
        affine[:3, 3] = self.to_world(first)
        return Grid(shape, affine)  # type: ignore[arg-type]

    def coarsened(self, factor: int) -> "Grid":
        """Merge `factor` x `factor` x `factor` voxels from the first on; the last may extend beyond
        the box, except along axes of fewer voxels than `factor`.
        """
        joined = [min(factor, n) for n in self.shape]
        affine, per_axis = self.affine.clone(), torch.tensor(joined[::-1], dtype=torch.float64)
        affine[:3, :3] *= per_axis
        affine[:3, 3] = self.to_world((per_axis - 1) / 2)
        z, y, x = (-(-n // k) for n, k in zip(self.shape, joined, strict=True))
        return Grid((z, y, x), affine)

    def divided(self, counts: Sequence[int]) -> "Grid":
        """The same box in `counts` voxels along (x, y, z)."""
        ratio = self.affine.new_tensor(self.size) / self.affine.new_tensor(counts)
        affine = self.affine.clone()
        affine[:3, :3] *= ratio
        affine[:3, 3] = self.to_world((ratio - 1) / 2)
        return Grid((counts[2], counts[1], counts[0]), affine)


def _check_shape(shape: Sequence[int], name: str = "shape", order: str = "(z, y, x)") -> None:
    if len(shape) != 3 or min(shape) < 1:
        raise ValueError(
            f"A grid's {name} must be three positive sizes {order}, got {tuple(shape)}"
        )


def _check_room(shape: Sequence[int]) -> None:
    check_memory(4 * math.prod(map(int, shape)), f"One volume of {tuple(shape)} voxels in float32")


def _counts(
    n: int | Sequence[int] | None,
    size: int | Sequence[int] | None,
    shape: Sequence[int] | None,
    steps: Sequence[float],
) -> tuple[int, int, int]:
    """Voxels along (z, y, x), from the one that is given; see `Grid.centred`."""
    options = [value for value in (n, size, shape) if value is not None]
    if len(options) != 1:
        raise TypeError(
            f"A grid needs one of n, size (x, y, z) and shape (z, y, x), got {n}, {size} and "
            f"{shape}"
        )
    counts = (options[0],) * 3 if isinstance(options[0], int) else tuple(options[0])
    if size is not None:
        _check_shape(counts, "size", "(x, y, z)")
        return counts[2], counts[1], counts[0]
    _check_shape(counts)
    z, y, x = counts
    if len(set(counts)) > 1 and (shape is None or len(set(steps)) > 1):
        raise ValueError(
            f"Sizes that differ are given as size=(x, y, z), the order of spacing and centre, got "
            f"{counts}; if that is a tensor's shape (z, y, x), expected size={(x, y, z)}"
        )
    return z, y, x


def voxel_centres(grid: Grid, dtype: torch.dtype = torch.float64) -> Float[Tensor, "d h w 3"]:
    """World positions (x, y, z) in mm of all voxel centres."""
    axes = [torch.arange(n, dtype=torch.float64) for n in grid.shape]
    z, y, x = torch.meshgrid(*axes, indexing="ij")
    return grid.to_world(torch.stack([x, y, z], dim=-1)).to(dtype)


def subdivided(volume: Shaped[Tensor, "*b d h w"], factor: int) -> Shaped[Tensor, "*b e i x"]:
    """Repeat voxels `factor` times along each axis, as `Grid.refined` splits them; the inverse of
    the mean.
    """
    for axis in (-3, -2, -1):
        volume = volume.repeat_interleave(factor, dim=axis)
    return volume


def pixel_centres(
    shape: Sequence[int], dtype: torch.dtype = torch.float64
) -> Float[Tensor, "v u 2"]:
    """Pixel coordinates (u, v) = (column, row) of all pixel centres of a detector of `shape` (rows,
    columns).
    """
    v, u = torch.meshgrid(*[torch.arange(n, dtype=dtype) for n in shape], indexing="ij")
    return torch.stack([u, v], dim=-1)


def coarse(grid: Grid, most: int) -> Grid:
    """The same box in mm in at most `most` voxels a side, about isotropic; the grid itself if it is
    as coarse.
    """
    lengths = grid.affine.new_tensor(grid.spacing) * grid.affine.new_tensor(grid.size)
    step = lengths.max() / most
    counts = [
        min(n, math.ceil(mm / step - 1e-6))
        for n, mm in zip(grid.size, lengths.tolist(), strict=True)
    ]
    return grid.divided(counts)


Three = tuple[int, int, int]


@dataclass(frozen=True)
class Box:
    """The voxels with low <= index < high along (z, y, x); empty if bounds meet.

    Args:
        low: first voxel along each axis.
        high: one past the last.
    """

    low: Three
    high: Three

    @classmethod
    def whole(cls, shape: Sequence[int]) -> "Box":
        """The whole volume of `shape` (z, y, x)."""
        return cls((0, 0, 0), three(shape))

    @classmethod
    def around(cls, mask: Bool[Tensor, "*n d h w"]) -> "Box":
        """The bounding box of the true voxels of all masks; empty for none."""
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
        """Number of voxels."""
        d, h, w = self.shape
        return d * h * w

    @property
    def slices(self) -> tuple[slice, slice, slice]:
        """Slices of the last three axes of a volume: `volume[..., *box.slices]`."""
        z, y, x = (slice(low, high) for low, high in zip(self.low, self.high, strict=True))
        return z, y, x

    def grown(self, voxels: int, shape: Sequence[int]) -> "Box":
        """Enlarge by so many voxels on every side, within a volume of `shape`; an empty box stays
        empty.
        """
        if not self.size:
            return self
        low = [max(0, bound - voxels) for bound in self.low]
        high = [min(int(n), bound + voxels) for bound, n in zip(self.high, shape, strict=True)]
        return Box(three(low), three(high))

    def aligned(self, multiple: int, shape: Sequence[int]) -> "Box":
        """Enlarge to bounds that are multiples of a number, or the volume's own."""
        low = [bound - bound % multiple for bound in self.low]
        high = [
            min(int(n), bound + -bound % multiple)
            for bound, n in zip(self.high, shape, strict=True)
        ]
        return Box(three(low), three(high))


def bounds(masks: Bool[Tensor, "b d h w"]) -> Int[Tensor, "b 6"]:
    """Bounding boxes of masks, each as its `low` and `high`, on the masks' device; zeros for empty
    masks.
    """
    columns = masks.any(dim=3)
    lines = columns.any(dim=2), columns.any(dim=1), masks.any(dim=1).any(dim=1)
    low = [line.int().argmax(dim=1) for line in lines]  # the first of the greatest
    high = [line.shape[1] - line.flip(1).int().argmax(dim=1) for line in lines]
    return torch.stack(low + high, dim=1) * lines[0].any(dim=1, keepdim=True)


def filled(bounds: Int[Tensor, "b 6"], shape: Sequence[int]) -> Bool[Tensor, "b d h w"]:
    """Masks of the voxels in boxes, from rows of `bounds`, on the bounds' device."""
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
    """Paste the part of a volume in a box into zeros of `shape`."""
    ends = zip(box.low, box.high, shape, strict=True)
    around = [(low, int(n) - high) for low, high, n in ends]
    return torch.nn.functional.pad(part, [voxels for pair in reversed(around) for voxels in pair])


def bricks_along(shape: Sequence[int], edge: int) -> Three:
    """Number of bricks along (z, y, x) that cover a volume of `shape`; the last may be cut."""
    return three(-(-int(n) // edge) for n in shape)


def three(values: Iterable[int]) -> Three:
    """Three integers (z, y, x)."""
    d, h, w = (int(value) for value in values)
    return d, h, w
