"""Where the samples of volumes lie, a world grid's and frusta's alike, and the maps from one
lattice into another.

An index (i, j, k), counted from the volume's centre, is lifted to (i s, j s, k, 1) with s = a + b
k. For each lattice one choice of (a, b) makes space and lifted index a homography of each other: s
= 1 for a world grid and for parallel beams, s in proportion to z for a central frustum. So is every
map between two lattices (projective coordinates: Hartley & Zisserman, Multiple View Geometry, ch. 2
and 3).

`sample` is the only caller of `grid_sample`: axis order and corner alignment are settled there.

Convention: coordinates are voxel indices in the order (x, y, z) = (last, middle, first axis of the
tensor), integer at voxel centres. Outside the outermost centres the values fade to zero over one
voxel.
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


def filled(values: Sequence[float], like: Tensor) -> Float[Tensor, " n"]:
    """Some numbers as a tensor of another one's device and type, written there: a GPU need not be
    waited for, as it would for a copy.
    """
    return torch.stack([like.new_full((), value) for value in values])


def normalised(index: Float[Tensor, "*n 3"], shape: tuple[int, int, int]) -> Float[Tensor, "*n 3"]:
    """Voxel indices as `grid_sample` wants them; points that are not finite or far outside land
    safely outside.
    """
    sizes = filled(shape[::-1], index)
    scaled = (2 * index + 1) / sizes - 1
    return torch.where(scaled.isfinite(), scaled, 4.0).clamp(-4.0, 4.0)


def sample(
    volume: Float[Tensor, "b c d h w"], points: Float[Tensor, "b k v u 3"]
) -> Float[Tensor, "b c k v u"]:
    """Values of volumes at normalised points (from `normalised`), zero outside.

    Order of accuracy: second in the voxel size. Coordinates stay float32 or wider whatever the
    volume's dtype.
    """
    if points.dtype != volume.dtype:
        return sample(volume.to(points.dtype), points).to(volume.dtype)
    if torch.are_deterministic_algorithms_enabled() and not volume.is_cpu:
        return gathered(volume, points)
    return F.grid_sample(volume, points, align_corners=False)


def gathered(
    volume: Float[Tensor, "b c d h w"], points: Float[Tensor, "b k v u 3"]
) -> Float[Tensor, "b c k v u"]:
    """What `grid_sample` gives, whose derivative on a GPU adds up in no fixed order; that of
    `gather` can.
    """
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


#: What turns an index into a place in another lattice: numerators of the three axes, denominator of
#: the first two, denominator of the third; each a bilinear function (c_i i + c_j j + c) + k (c_ik i
#: + c_jk j + c_k) of the index.
NUMERATORS, ACROSS, DEPTH = slice(0, 3), 3, 4
#: Of half a box: a sample so little outside of a face lies on it, but for rounding.
FACE = 1e-9


@dataclass(frozen=True, eq=False)
class Lattice:
    """The samples of M volumes of one shape.

    Args:
        shape: samples along the tensor's axes (k, j, i).
        matrix: from space, in voxels of one grid about its centre, to lifted indices; denominators
            are positive on the side of the source that counts.
        lift: (a, b) of s = a + b k.
    """

    shape: tuple[int, int, int]
    matrix: Float[Tensor, "m 4 4"]
    lift: Float[Tensor, "m 2"]

    @property
    def ahead(self) -> Bool[Tensor, "m k"]:
        """Which planes k lie on the side of the source that counts."""
        k = torch.arange(self.shape[0]).to(self.lift) - (self.shape[0] - 1) / 2
        return self.lift[:, :1] + self.lift[:, 1:] * k > 0


def centred_affine(grid: Grid) -> Float[Tensor, "4 4"]:
    """From voxel indices about the grid's centre to world mm."""
    affine = grid.affine.clone()
    affine[:3, 3] = grid.centre
    return affine


def grid_lattice(grid: Grid) -> Lattice:
    """The voxels of the grid by which space is measured."""
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
    `Cameras.project`; rows 3 and 4 stand as in PyTorch3D's K. For parallel beams H = [P1; P2;
    depth; (0, 0, 0, 1)].
    """
    central = replace(cameras, parallel=False).matrix * cameras.distance[:, None, None]
    unit = central.new_tensor([0, 0, 0, 1]).expand(len(cameras), 4)
    if cameras.parallel:
        P = cameras.matrix
        return torch.stack([P[:, 0], P[:, 1], central[:, 2], unit], dim=1)
    return torch.stack([central[:, 0], central[:, 1], f * unit, central[:, 2]], dim=1)


def lattice_maps(of: Lattice, to: Lattice) -> Float[Tensor, "s k 5 2 3"]:
    """Where each sample of every lattice of `to` lies in every lattice of `of`; rows NUMERATORS,
    ACROSS and DEPTH.

    A volume on `of` warped by them is the same field on `to`. All pairs: frusta to one grid [m 1
    ..], one grid to frusta [1 m ..], frusta to frusta [m m ..].
    """
    H = of.matrix[:, None] @ torch.linalg.inv(to.matrix)[None]
    return lifted_maps(H, of.lift[:, None], to.lift[None])


def lifted_maps(
    H: Float[Tensor, "*n 4 4"],
    of: Float[Tensor, "*#n 2"] | None = None,
    to: Float[Tensor, "*#n 2"] | None = None,
) -> Float[Tensor, "*n 5 2 3"]:
    """The maps of a homography between lifted indices; without lifts H relates the centred indices
    themselves.
    """
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
    """The values of bilinear maps at the centred indices of all samples of a volume of `shape`."""
    planes, j, i = _planes(maps, shape)
    x, y, one = planes[..., None, None, :].unbind(dim=-1)
    return (x * i + y * j[:, None] + one).movedim(-4, -1)


def _planes(
    maps: Tensor, shape: tuple[int, int, int]
) -> tuple[Float[Tensor, "*n r d 3"], Tensor, Tensor]:
    """Bilinear maps on each plane k, where they are x i + y j + one, and the centred indices j and
    i.
    """
    k, j, i = (torch.arange(n, dtype=maps.dtype, device=maps.device) - (n - 1) / 2 for n in shape)
    return maps[..., 0, None, :] + k[:, None] * maps[..., 1, None, :], j, i


def places(
    maps: Float[Tensor, "*n 5 2 3"], shape: tuple[int, int, int]
) -> tuple[Float[Tensor, "*n d h w 3"], Bool[Tensor, "*n d h w"]]:
    """Centred indices in the source lattice of all samples of an output of `shape`, and which of
    them count.

    Samples behind the plane of a source do not count; their place means nothing.
    """
    rows = spread_map(maps, shape)
    # one by one: a list of indices would have to be copied to a GPU
    under = torch.stack([rows[..., k] for k in (ACROSS, ACROSS, DEPTH)], dim=-1)
    counts = (under > 0).all(dim=-1)
    return rows[..., NUMERATORS] / torch.where(counts[..., None], under, 1.0), counts


@dataclass(frozen=True, eq=False)
class Spans:
    """Samples of volumes that lie in a convex body: of each row those from `first` to before `end`.

    Args:
        first: index of the first sample along a row.
        end: of the one behind the last; a row without a sample has no greater one than `first`.
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
        """Whether each sample lies in the body."""
        i = torch.arange(self.width, dtype=self.first.dtype, device=self.first.device)
        return (i >= self.first[..., None]) & (i < self.end[..., None])

    def to(self, device: torch.device) -> "Spans":
        """On another device."""
        return replace(self, first=self.first.to(device), end=self.end.to(device))


def enclosed(
    maps: Float[Tensor, "*n 5 2 3"], source: tuple[int, int, int], shape: tuple[int, int, int]
) -> Spans:
    """Which samples of an output of `shape` lie in the source lattice's box, ahead of its source;
    its faces count.

    Every face is a half-space, which cuts a row of samples at one place: no sample's own place is
    worked out.
    """
    planes, j, _ = _planes(maps, shape)
    half = maps.new_tensor(source[::-1])[:, None, None] / 2 * (1 + FACE)
    top, under = planes[..., NUMERATORS, :, :], planes[..., [ACROSS, ACROSS, DEPTH], :, :] * half
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
