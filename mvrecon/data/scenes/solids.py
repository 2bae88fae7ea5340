"""Solids with line integrals in closed form: ellipsoids, finite elliptic cylinders, boxes; each may
be cut by planes.

In its own frame, p = diag(1/a) R^T (X - c), every solid is a unit ball in its first k axes times a
slab |p| < 1 in each of the others: k = 3 for an ellipsoid, 2 for a cylinder, 0 for a box. A ray p =
o + t q meets the ball between the roots of |q|^2 t^2 + 2 (o.q) t + |o|^2 - 1, whose discriminant
|q|^2 - |o x q|^2 avoids cancellation, each slab between its two planes, and each half-space n.X <=
c that cuts the solid on one side of its plane. All are convex, so a ray has one chord. Values of
overlapping solids add up.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import combinations, product
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn.functional import avg_pool2d

from mvrecon.geometry.cameras.camera import Cameras
from mvrecon.geometry.grid import Grid

#: The number of round axes; along the others a solid is a slab.
ROUND_AXES = {"ellipsoid": 3, "cylinder": 2, "box": 0}
#: Pairs of ray and solid at a time, so that working arrays stay in the cache.
PAIRS = 2**16


@dataclass(frozen=True, eq=False)
class Solids:
    """Solids of one kind.

    Args:
        kind: "ellipsoid", "cylinder" (its axis is the solid's z), or "box".
        centres: centre of each solid, world mm.
        rotations: each solid's axes in the world, as columns.
        semi_axes: half lengths in mm along the solid's own x, y, z.
        values: value that each solid adds to the points inside it.
        cuts: half-spaces (n, c) in the world: only points with n.X <= c, in mm, are in the solid.
            None: whole solids.

    Raises:
        ValueError: an unknown kind, shapes that do not agree, values that are not finite, sizes
            that are not positive, or matrices that are not rotations.
    """

    kind: str
    centres: Float[Tensor, "n 3"]
    rotations: Float[Tensor, "n 3 3"]
    semi_axes: Float[Tensor, "n 3"]
    values: Float[Tensor, " n"]
    cuts: Float[Tensor, "n k 4"] | None = None

    def __post_init__(self) -> None:
        if self.kind not in ROUND_AXES:
            raise ValueError(f"Unknown kind of solid {self.kind!r}. Known: {', '.join(ROUND_AXES)}")
        n = len(torch.as_tensor(self.values))
        if self.cuts is None:
            object.__setattr__(self, "cuts", torch.zeros(n, 0, 4))
        planes = torch.as_tensor(self.cuts).shape[1]
        for name, shape in (
            ("centres", (n, 3)),
            ("rotations", (n, 3, 3)),
            ("semi_axes", (n, 3)),
            ("values", (n,)),
            ("cuts", (n, planes, 4)),
        ):
            value = torch.as_tensor(getattr(self, name)).to(torch.float64)
            if value.shape != shape or not value.isfinite().all():
                raise ValueError(
                    f"{n} solids need finite {name} of shape {shape}, got {value.tolist()}"
                )
            object.__setattr__(self, name, value)
        if not (self.semi_axes > 0).all():
            raise ValueError(f"Solids need positive semi-axes in mm, got {self.semi_axes.tolist()}")
        unit = torch.eye(3, dtype=torch.float64)
        if not torch.allclose(self.rotations.mT @ self.rotations, unit.expand(n, 3, 3), atol=1e-6):
            raise ValueError(
                f"Solids need rotations with orthonormal columns, got {self.rotations.tolist()}"
            )

    @classmethod
    def upright(
        cls,
        kind: str,
        centres: Float[Tensor, "n 3"],
        semi_axes: Float[Tensor, "n 3"],
        values: Float[Tensor, " n"],
        cuts: Float[Tensor, "n k 4"] | None = None,
    ) -> "Solids":
        """Solids whose axes are the world's."""
        rotations = torch.eye(3).expand(len(values), 3, 3)
        return cls(kind, centres, rotations, semi_axes, values, cuts)

    @property
    def round_axes(self) -> int:
        """The number of round axes: 3 for an ellipsoid, 2 for a cylinder, 0 for a box."""
        return ROUND_AXES[self.kind]

    @property
    def to_unit(self) -> Float[Tensor, "n 3 3"]:
        """diag(1/a) R^T: from the world's directions to the unit solid's frame."""
        return self.rotations.mT / self.semi_axes[..., None]

    @property
    def unit_cuts(self) -> Float[Tensor, "n k 4"]:
        """The half-spaces in each unit solid's frame: n.p <= c."""
        normal, limit = self.cuts[..., :3], self.cuts[..., 3]  # type: ignore[index]
        own = normal @ self.rotations * self.semi_axes[:, None]
        rest = limit - (normal @ self.centres[..., None])[..., 0]
        return torch.cat([own, rest[..., None]], dim=-1)

    def chords(
        self,
        start: Float[Tensor, "r 3"],
        step: Float[Tensor, "r 3"],
        ray_extent: tuple[float, float],
    ) -> "Chords":
        """Return the chords of rays X = start + t step, t in `ray_extent`, in the solids;
        float64.
        """
        A = self.to_unit.to(start.device)
        offset = (A @ self.centres.to(start.device)[..., None])[..., 0]
        k = self.round_axes
        o = A[:, :k].transpose(0, 1) @ start.T - offset.T[:k, :, None]
        q = A[:, :k].transpose(0, 1) @ step.T
        solid, ray, enter, leave = _ball(o, q, ray_extent)
        o = (A[solid, k:] @ start[ray, :, None])[..., 0] - offset[solid, k:]
        q = (A[solid, k:] @ step[ray, :, None])[..., 0]
        for a, b in zip(((-1 - o) / q).unbind(dim=-1), ((1 - o) / q).unbind(dim=-1), strict=True):
            enter = torch.maximum(enter, torch.minimum(a, b))
            leave = torch.minimum(leave, torch.maximum(a, b))
        cuts = self.cuts.to(start.device)[solid]  # type: ignore[union-attr]
        o = (cuts[..., :3] @ start[ray, :, None])[..., 0] - cuts[..., 3]
        q = (cuts[..., :3] @ step[ray, :, None])[..., 0]
        for a, b in zip(o.unbind(dim=-1), q.unbind(dim=-1), strict=True):  # a + t b <= 0
            at = torch.where(b == 0, torch.where(a <= 0, torch.inf, -torch.inf), -a / b)
            enter = torch.where(b < 0, torch.maximum(enter, at), enter)
            leave = torch.where(b < 0, leave, torch.minimum(leave, at))
        return Chords(solid, ray, enter, leave)

    def integrals(
        self,
        start: Float[Tensor, "r 3"],
        step: Float[Tensor, "r 3"],
        ray_extent: tuple[float, float],
    ) -> Float[Tensor, " r"]:
        """Integrals over X = start + t step with t in `ray_extent`, in value * mm; float64."""
        solid, ray, enter, leave = self.chords(start, step, ray_extent)
        chord = torch.where(leave > enter, leave - enter, 0.0) * step.norm(dim=-1)[ray]
        return start.new_zeros(len(start)).index_add(
            0, ray, chord * self.values.to(start.device)[solid]
        )

    def sums(self, xyz: Float[Tensor, "r 3"]) -> Float[Tensor, " r"]:
        """Sum of the values of the solids around each point; float64."""
        p = torch.einsum("nij,rnj->irn", self.to_unit.to(xyz), xyz[:, None] - self.centres.to(xyz))
        inside = contains(p, self.round_axes)
        for cut in self.cuts.to(xyz).unbind(dim=1):  # type: ignore[union-attr]
            inside &= xyz @ cut[:, :3].T <= cut[:, 3]
        return inside.to(xyz) @ self.values.to(xyz)

    def moved(self, R: Float[Tensor, "3 3"], t: Float[Tensor, "3"]) -> "Solids":
        """The solids after the motion X -> R X + t."""
        R, t = R.to(self.centres), t.to(self.centres)
        normal = self.cuts[..., :3] @ R.T  # type: ignore[index]
        limit = self.cuts[..., 3] + normal @ t  # type: ignore[index]
        return replace(
            self,
            centres=self.centres @ R.T + t,
            rotations=R @ self.rotations,
            cuts=torch.cat([normal, limit[..., None]], dim=-1),
        )


class Chords(NamedTuple):
    """Pairs of a solid and a ray that meet.

    Args:
        solid: index of the solid.
        ray: index of the ray.
        enter: t at which the ray enters the solid; it misses the solid if this is not below
            `leave`.
        leave: t at which it leaves.
    """

    solid: Int[Tensor, " h"]
    ray: Int[Tensor, " h"]
    enter: Float[Tensor, " h"]
    leave: Float[Tensor, " h"]


def contains(p: Float[Tensor, "3 ..."], round_axes: int) -> Bool[Tensor, "..."]:
    """Whether points lie in the unit solid with so many round axes."""
    inside = p[:round_axes].square().sum(dim=0) <= 1
    return inside & (p[round_axes:].abs() <= 1).all(dim=0)


def _ball(
    o: Float[Tensor, "k n r"], q: Float[Tensor, "k n r"], ray_extent: tuple[float, float]
) -> tuple[Int[Tensor, " h"], Int[Tensor, " h"], Float[Tensor, " h"], Float[Tensor, " h"]]:
    """Solid and ray of every pair that meets in the round axes, and the t in `ray_extent` at which
    the ray enters and leaves the ball.
    """
    qq = q.square().sum(dim=0)
    crosses = (o[i] * q[j] - o[j] * q[i] for i, j in combinations(range(len(o)), 2))
    disc = sum((-cross.square() for cross in crosses), start=qq)
    along = qq == 0  # parallel to a cylinder's axis, or a box: the ray is either inside or outside
    hit = (disc > 0) | (along & (o.square().sum(dim=0) < 1)) if along.any() else disc > 0
    solid, ray = at = hit.nonzero(as_tuple=True)  # to index by the mask would find them each time
    o, q, qq, disc, along = o[:, *at], q[:, *at], qq[at], disc[at], along[at]
    middle = torch.where(along, 0.0, -(o * q).sum(dim=0) / qq)
    half = torch.where(along, torch.inf, disc.sqrt() / qq)
    low, high = ray_extent
    return solid, ray, (middle - half).clamp(min=low), (middle + half).clamp(max=high)


@dataclass(frozen=True, eq=False)
class Phantom:
    """An object made of solids, whose values add up where they overlap.

    Args:
        parts: batches of solids, each of one kind.
    """

    parts: tuple[Solids, ...]

    def integrals(
        self,
        start: Float[Tensor, "*n 3"],
        end: Float[Tensor, "*n 3"],
        ray_extent: tuple[float, float] = (0.0, 1.0),
    ) -> Float[Tensor, "*n"]:
        """Exact line integrals in value * mm over X = start + w (end - start), w in `ray_extent`
        (which may be infinite).

        Computed in float64, returned in the dtype of `start`. Tangent rays give zero.
        """
        first, last = (
            x.reshape(-1, 3).to(torch.float64) for x in torch.broadcast_tensors(start, end)
        )
        total = first.new_zeros(len(first))
        for part, rays in self._chunks(len(first)):
            total[rays] += part.integrals(first[rays], last[rays] - first[rays], ray_extent)
        return total.reshape(torch.broadcast_shapes(start.shape, end.shape)[:-1]).to(start.dtype)

    def views(self, cameras: Cameras, rays: int = 1) -> Float[Tensor, "m v u"]:
        """Exact views in value * mm, in float64: a pixel is the mean over rays x rays evenly
        distributed rays.
        """
        fine = cameras.refined(rays)
        exact = (self.integrals(*one.rays(), ray_extent=one.ray_extent) for one in fine)
        return torch.cat([avg_pool2d(view, rays) for view in exact])

    def values(self, xyz: Float[Tensor, "*n 3"]) -> Float[Tensor, "*n"]:
        """Value at world points in mm, in the dtype of `xyz`."""
        points = xyz.reshape(-1, 3).to(torch.float64)
        total = points.new_zeros(len(points))
        for part, chunk in self._chunks(len(points)):
            total[chunk] += part.sums(points[chunk])
        return total.reshape(xyz.shape[:-1]).to(xyz.dtype)

    def moved(self, R: Float[Tensor, "3 3"], t: Float[Tensor, "3"]) -> "Phantom":
        """The phantom after the rigid motion X -> R X + t of the world."""
        return Phantom(tuple(part.moved(R, t) for part in self.parts))

    def support(self) -> "Phantom":
        """The same solids, each of value one: positive inside any of them."""
        return Phantom(
            tuple(replace(part, values=torch.ones_like(part.values)) for part in self.parts)
        )

    def _chunks(self, count: int) -> Iterator[tuple[Solids, slice]]:
        for part in self.parts:
            size = max(1, PAIRS // max(1, len(part.values)))
            yield from ((part, slice(first, first + size)) for first in range(0, count, size))


#: Sub-voxel points at a time, which bounds the memory.
BLOCK_POINTS = 2**18


def voxelise(phantom: Phantom, grid: Grid, factor: int = 4) -> Float[Tensor, "d h w"]:
    """Mean of the phantom's value over factor^3 points of each voxel, in float32.

    Equals the average of `phantom.values` at the voxel centres of `grid.refined(factor)`. Only
    voxels that a solid's surface may cross are subdivided, so time grows with the surface, not the
    volume.

    Raises:
        ValueError: a factor below one.
    """
    return values_and_touched(phantom, grid, factor)[0]


def values_and_touched(
    phantom: Phantom, grid: Grid, factor: int
) -> tuple[Float[Tensor, "d h w"], Bool[Tensor, "d h w"]]:
    """The volume of `voxelise`, and the voxels with a point in a solid, also where the values of
    several cancel.

    Raises:
        ValueError: as `voxelise`.
    """
    if factor < 1:
        raise ValueError(f"Supersampling needs a factor of at least 1, got {factor}")
    volume = torch.zeros(grid.shape, dtype=torch.float64)
    touched = torch.zeros(grid.shape, dtype=torch.bool)
    for part in phantom.parts:
        for n, value in enumerate(part.values):
            block, share = _share(grid, part, n, factor)
            volume[block] += value * share
            touched[block] |= value * share != 0
    return volume.to(torch.float32), touched


def _share(
    grid: Grid, part: Solids, n: int, factor: int
) -> tuple[tuple[slice, slice, slice], Float[Tensor, "d h w"]]:
    """The block of voxels around the n-th solid, and the share of each that the solid fills."""
    k = part.round_axes
    # from directions in voxels to the unit solid's frame
    to_unit = part.to_unit[n] @ grid.affine[:3, :3]
    centre = grid.to_index(part.centres[n])
    block = _block(grid, centre, torch.linalg.inv(to_unit), k)
    z, y, x = torch.meshgrid(
        *[torch.arange(s.start, s.stop, dtype=torch.float64) for s in block], indexing="ij"
    )
    p = torch.einsum("ij,j...->i...", to_unit, torch.stack([x, y, z]) - centre[:, None, None, None])
    # distance of a voxel's corners from its centre, along each axis
    reach = to_unit.abs().sum(dim=1) / 2
    radius = p[:k].square().sum(dim=0).sqrt()  # `norm` is far slower
    flat = p[k:].abs() - reach[k:, None, None, None]
    touched = (radius <= 1 + reach[:k].norm()) & (flat <= 1).all(dim=0)
    full = radius <= 1 - reach[:k].norm()
    full &= (flat + 2 * reach[k:, None, None, None] <= 1).all(dim=0)
    cuts = part.unit_cuts[n]
    for cut in cuts:
        beyond = torch.einsum("i,i...->...", cut[:3], p) - cut[3]  # of a voxel's centre
        half = (cut[:3] @ to_unit).abs().sum() / 2
        touched &= beyond <= half
        full &= beyond <= -half
    share = full.to(torch.float64)
    edge = touched & ~full
    share[edge] = _shares(p[:, edge], to_unit, (k, cuts), factor)
    return block, share


def _block(
    grid: Grid, centre: Float[Tensor, "3"], frame: Float[Tensor, "3 3"], k: int
) -> tuple[slice, slice, slice]:
    """The (z, y, x) block of voxels that the box around a solid meets; `frame` maps the unit solid
    to voxels.
    """
    half = frame[:, :k].norm(dim=1) + frame[:, k:].abs().sum(dim=1) + 0.5
    low, high = (centre - half).ceil().long().tolist(), (centre + half).floor().long().tolist()
    x, y, z = (
        slice(min(n, max(0, a)), max(0, min(n, b + 1)))
        for a, b, n in zip(low, high, grid.shape[::-1], strict=True)
    )
    return z, y, x


def _shares(
    p: Float[Tensor, "3 e"],
    to_unit: Float[Tensor, "3 3"],
    shape: tuple[int, Float[Tensor, "k 4"]],
    factor: int,
) -> Float[Tensor, " e"]:
    """Share of each voxel's factor^3 points in the unit solid with so many round axes and
    half-spaces.
    """
    round_axes, cuts = shape
    steps = ((torch.arange(factor, dtype=torch.float64) + 0.5) / factor - 0.5).tolist()
    points = to_unit @ torch.tensor(list(product(steps, repeat=3)), dtype=torch.float64).T
    shares = []
    for chunk in p.split(max(1, BLOCK_POINTS // factor**3), dim=1):
        at = chunk[:, :, None] + points[:, None]
        inside = contains(at, round_axes)
        for cut in cuts:
            inside &= torch.einsum("i,i...->...", cut[:3], at) <= cut[3]
        shares.append(inside.to(torch.float64).mean(dim=-1))
    return torch.cat(shares)
