"""Sample positions of volumes, on a world grid or in frusta, and the maps between lattices.

An index (i, j, k), counted from the volume's centre, is lifted to (i s, j s, k, 1) with s = a + b
k. For each lattice one choice of (a, b) relates space and lifted index by a homography: s = 1 for a
world grid and for parallel beams, s proportional to z for a central frustum. Hence every map
between two lattices is a homography (projective coordinates: Hartley & Zisserman, Multiple View
Geometry, ch. 2 and 3).

`sample` is the only caller of `grid_sample`, and settles axis order and corner alignment.

Convention: coordinates are voxel indices in the order (x, y, z) = (last, middle, first axis of the
tensor), integer at voxel centres. Beyond the outermost centres values fade to zero over one voxel.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int
from torch import Tensor

from mvrecon.geometry.cameras.camera import Cameras
from mvrecon.geometry.grid import Grid

#: Whether `grid_sample` has no second derivative in volumes: before torch 2.13.
NO_SECOND_DERIVATIVE = tuple(map(int, torch.__version__.split(".")[:2])) < (2, 13)


def filled(values: Sequence[float], like: Tensor) -> Float[Tensor, " n"]:
    """A tensor of numbers on the device and in the dtype of another, filled there: a copy would
    synchronise with a GPU.
    """
    return torch.stack([like.new_full((), value) for value in values])


def normalised(index: Float[Tensor, "*n 3"], shape: tuple[int, int, int]) -> Float[Tensor, "*n 3"]:
    """Convert voxel indices to `grid_sample`'s coordinates; non-finite and far points become safely
    outside.
    """
    sizes = filled(shape[::-1], index)
    scaled = (2 * index + 1) / sizes - 1
    return torch.where(scaled.isfinite(), scaled, 4.0).clamp(-4.0, 4.0)


def sample(
    volume: Float[Tensor, "b c d h w"], points: Float[Tensor, "b k v u 3"]
) -> Float[Tensor, "b c k v u"]:
    """Interpolate volumes at normalised points (from `normalised`), zero outside.

    Order of accuracy: second in the voxel size. Coordinates stay float32 or wider whatever the
    volume's dtype.
    """
    if points.dtype != volume.dtype:
        return sample(volume.to(points.dtype), points).to(volume.dtype)
    deterministic = torch.are_deterministic_algorithms_enabled() and not volume.is_cpu
    if deterministic or NO_SECOND_DERIVATIVE:
        return gathered(volume, points)
    return F.grid_sample(volume, points, align_corners=False)


def gathered(
    volume: Float[Tensor, "b c d h w"], points: Float[Tensor, "b k v u 3"]
) -> Float[Tensor, "b c k v u"]:
    """`grid_sample` by `gather`, with second derivatives, deterministic on a GPU if required."""
    places = ((points + 1) * filled(volume.shape[:1:-1], points) - 1) / 2
    low, flat = places.detach().floor(), volume.flatten(2)
    sizes = filled(volume.shape[:1:-1], low).long()
    values = volume.new_zeros(*volume.shape[:2], *points.shape[1:4])
    for corner in product((0, 1), repeat=3):
        at = (low + filled(corner, low)).long()
        inside = ((at >= 0) & (at < sizes)).all(dim=-1)
        x, y, z = at.where(inside[..., None], 0).unbind(dim=-1)
        index = (
            ((z * sizes[1] + y) * sizes[0] + x).flatten(1)[:, None].expand(-1, flat.shape[1], -1)
        )
        along_x, along_y, along_z = (1 - (places - at).abs()).unbind(dim=-1)
        share = along_x * along_y * along_z * inside
        values = values + flat.gather(2, index).unflatten(2, inside.shape[1:]) * share[:, None]
    return values


#: Maps from an index to a position in another lattice: numerators of the three axes, denominator of
#: the first two, denominator of the third; each a bilinear function (c_i i + c_j j + c) + k (c_ik i
#: + c_jk j + c_k) of the index.
NUMERATORS, ACROSS_DENOMINATOR, DEPTH_DENOMINATOR = slice(0, 3), 3, 4
#: Tolerance of faces relative to half a box, for rounding.
FACE_TOLERANCE = 1e-9


@dataclass(frozen=True, eq=False)
class Lattice:
    """The samples of M volumes of one shape.

    Args:
        shape: samples along the tensor's axes (k, j, i).
        matrix: map from space, in voxels of one grid about its centre, to lifted indices;
            denominators are positive on the valid side of the source.
        lift: (a, b) of s = a + b k.
    """

    shape: tuple[int, int, int]
    matrix: Float[Tensor, "m 4 4"]
    lift: Float[Tensor, "m 2"]

    @property
    def ahead(self) -> Bool[Tensor, "m k"]:
        """Whether planes k are on the valid side of the source."""
        k = torch.arange(self.shape[0]).to(self.lift) - (self.shape[0] - 1) / 2
        return self.lift[:, :1] + self.lift[:, 1:] * k > 0


def centred_affine(grid: Grid) -> Float[Tensor, "4 4"]:
    """Map from voxel indices about the grid's centre to world mm."""
    affine = grid.affine.clone()
    affine[:3, 3] = grid.centre
    return affine


def grid_lattice(grid: Grid) -> Lattice:
    """The lattice of the grid that defines the unit of space."""
    return Lattice(
        grid.shape, torch.eye(4).to(grid.affine)[None], grid.affine.new_tensor([[1.0, 0.0]])
    )


def depth_edges(z_range: Float[Tensor, "m 2"], count: int) -> Float[Tensor, "m e"]:
    """The count + 1 planes that bound the depth bins of each camera, in mm."""
    t = torch.linspace(0, 1, count + 1, dtype=z_range.dtype, device=z_range.device)
    near, far = z_range[:, :1], z_range[:, 1:]
    return near + (far - near) * t


def to_frustum(cameras: Cameras, f: float = 1.0) -> Float[Tensor, "m 4 4"]:
    """The frustum's homography H: X in mm to (u, v, k) with k = f / z; for parallel beams, to (u,
    v, z).

    Convention: H = [P1; P2; (0, 0, 0, f); P3] with P scaled so that w = z in mm, signed as in
    `Cameras.project`; rows 3 and 4 as in PyTorch3D's K. For parallel beams H = [P1; P2; depth; (0,
    0, 0, 1)].
    """
    central = replace(cameras, parallel=False).matrix * cameras.distance[:, None, None]
    unit = central.new_tensor([0, 0, 0, 1]).expand(len(cameras), 4)
    if cameras.parallel:
        P = cameras.matrix
        return torch.stack([P[:, 0], P[:, 1], central[:, 2], unit], dim=1)
    return torch.stack([central[:, 0], central[:, 1], f * unit, central[:, 2]], dim=1)


def lattice_maps(of: Lattice, to: Lattice) -> Float[Tensor, "s k 5 2 3"]:
    """Position of each sample of every lattice of `to` in every lattice of `of`; rows `NUMERATORS`,
    `ACROSS_DENOMINATOR` and `DEPTH_DENOMINATOR`.

    Warping a volume on `of` by them resamples it on `to`. All pairs: frusta to one grid [m 1 ..],
    one grid to frusta [1 m ..], frusta to frusta [m m ..].
    """
    H = of.matrix[:, None] @ torch.linalg.inv(to.matrix)[None]
    return lifted_maps(H, of.lift[:, None], to.lift[None])


def lifted_maps(
    H: Float[Tensor, "*n 4 4"],
    of: Float[Tensor, "*#n 2"] | None = None,
    to: Float[Tensor, "*#n 2"] | None = None,
) -> Float[Tensor, "*n 5 2 3"]:
    """The maps of a homography between lifted indices; without lifts, between centred indices."""
    plain = H.new_tensor([1.0, 0.0])
    of, to = plain if of is None else of, plain if to is None else to
    across = of[..., :1] * H[..., 3, :] + of[..., 1:] * H[..., 2, :]
    rows = torch.cat([H[..., :3, :], across[..., None, :], H[..., 3:, :]], dim=-2)
    a, b = to[..., None, :1], to[..., None, 1:]
    fixed = torch.cat([a * rows[..., :2], rows[..., 3:]], dim=-1)
    growing = torch.cat([b * rows[..., :2], rows[..., 2:3]], dim=-1)
    return torch.stack([fixed, growing], dim=-2)


def spread_map(
    maps: Float[Tensor, "*n r 2 3"], shape: tuple[int, int, int]
) -> Float[Tensor, "*n d h w r"]:
    """Evaluate bilinear maps at the centred indices of all samples of a volume of `shape`."""
    planes, j, i = _planes(maps, shape)
    x, y, one = planes[..., None, None, :].unbind(dim=-1)
    return (x * i + y * j[:, None] + one).movedim(-4, -1)


def _planes(
    maps: Tensor, shape: tuple[int, int, int]
) -> tuple[Float[Tensor, "*n r d 3"], Tensor, Tensor]:
    """Bilinear maps on each plane k, as x i + y j + one, and the centred indices j and i."""
    k, j, i = (torch.arange(n, dtype=maps.dtype, device=maps.device) - (n - 1) / 2 for n in shape)
    return maps[..., 0, None, :] + k[:, None] * maps[..., 1, None, :], j, i


def places(
    maps: Float[Tensor, "*n 5 2 3"], shape: tuple[int, int, int]
) -> tuple[Float[Tensor, "*n d h w 3"], Bool[Tensor, "*n d h w"]]:
    """Centred source indices of all samples of an output of `shape`, and whether they are valid.

    Samples behind the plane of a source are invalid, with arbitrary positions.
    """
    rows = spread_map(maps, shape)
    # one by one: a list of indices would be copied to a GPU
    under = torch.stack(
        [rows[..., k] for k in (ACROSS_DENOMINATOR, ACROSS_DENOMINATOR, DEPTH_DENOMINATOR)], dim=-1
    )
    counts = (under > 0).all(dim=-1)
    return rows[..., NUMERATORS] / torch.where(counts[..., None], under, 1.0), counts


@dataclass(frozen=True, eq=False)
class Spans:
    """Samples of volumes in a convex body: in each row those from `first` up to `end`.

    Args:
        first: index of the first sample along a row.
        end: one past the last; at most `first` for an empty row.
        width: samples of a row.
    """

    first: Int[Tensor, "*n d h"]
    end: Int[Tensor, "*n d h"]
    width: int

    @property
    def shape(self) -> tuple[int, int, int]:
        """Samples (d, h, w)."""
        d, h = self.first.shape[-2:]
        return d, h, self.width

    @property
    def mask(self) -> Bool[Tensor, "*n d h w"]:
        """Whether each sample is in the body."""
        i = torch.arange(self.width, dtype=self.first.dtype, device=self.first.device)
        return (i >= self.first[..., None]) & (i < self.end[..., None])

    def to(self, device: torch.device) -> "Spans":
        """Move to another device."""
        return replace(self, first=self.first.to(device), end=self.end.to(device))


def enclosed(
    maps: Float[Tensor, "*n 5 2 3"], source: tuple[int, int, int], shape: tuple[int, int, int]
) -> Spans:
    """Return the samples of an output of `shape` in the source lattice's box, including its faces,
    ahead of its source.

    Every face is a half-space, which cuts a row of samples once, so no sample's position is
    computed.
    """
    planes, j, _ = _planes(maps, shape)
    half = maps.new_tensor(source[::-1])[:, None, None] / 2 * (1 + FACE_TOLERANCE)
    top = planes[..., NUMERATORS, :, :]
    under = planes[..., [ACROSS_DENOMINATOR, ACROSS_DENOMINATOR, DEPTH_DENOMINATOR], :, :] * half
    low = high = maps.new_tensor(0.0)
    low, high = low - torch.inf, high + torch.inf
    for face in torch.cat([under - top, under + top], dim=-3).unbind(dim=-3):  # positive within
        x, y, one = (part[..., None] for part in face.unbind(dim=-1))  # [*n d 1]
        rest = y * j + one
        cut, never = -rest / x, torch.where(rest > 0, -torch.inf, torch.inf)
        low = low.maximum(torch.where(x > 0, cut, torch.where(x < 0, -torch.inf, never)))
        high = high.minimum(torch.where(x < 0, cut, torch.inf))
    width = shape[2]
    first = (low + (width - 1) / 2).floor() + 1
    end = (high + (width - 1) / 2).ceil()
    first, end = (index.clamp(0, width).to(torch.int16) for index in (first, end))
    return Spans(first, end, width)
