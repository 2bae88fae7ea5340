"""Each camera's frame in a learned method: its frustum in coarse bins, its view in cells of pixels,
and the warps between frusta and the volume.

In a camera's own frustum projection is a plain sum, p[v, u] = sum over d of g[d, v, u] * step[v,
u], so lifting by division by the step conserves every ray integral exactly. A warp is one trilinear
interpolation per bin or voxel.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor

from mvrecon.core.numbers import divided
from mvrecon.geometry import lattice
from mvrecon.geometry.cameras.camera import Cameras
from mvrecon.geometry.cameras.field import seen_depth_range
from mvrecon.geometry.grid import Grid
from mvrecon.kernels.warps import warp
from mvrecon.methods.learned.geometry import Geometry
from mvrecon.methods.learned.unet import from_cells, halved, padded, to_cells, trimmed
from mvrecon.operators.memo import grid_key, kept, place
from mvrecon.operators.operator import sees_integrals


def frusta_lattice(cameras: Cameras, grid: Grid, edges: Float[Tensor, "m e"]) -> lattice.Lattice:
    """The bins (depth, row, column) of the cameras' frusta, in float64; differentiable in the
    cameras.

    Args:
        cameras: the rig; its pixels are the frusta's rows and columns.
        grid: unit and origin of space: its voxels and centre.
        edges: the planes in mm between the depth bins, from `depth_edges`.
    """
    H = lattice.to_frustum(cameras) @ lattice.centred_affine(grid).to(cameras.source)
    count = edges.shape[1] - 1
    middle, step = (edges[:, -1] + edges[:, 0]) / 2, (edges[:, -1] - edges[:, 0]) / count
    if cameras.parallel:  # homogeneous (u, v, z, 1)
        scale, across = torch.ones_like(middle), H[:, 3, None]
        lift = torch.stack([scale, torch.zeros_like(scale)], dim=-1)
    else:
        H = H[:, [0, 1, 3, 2]]  # homogeneous (u z, v z, z, 1)
        side = 1.0 if cameras.ray_extent[1] > 0 else -1.0
        scale, across = side / edges.abs().amax(dim=1), H[:, 2, None]
        lift = torch.stack([scale * middle, scale * step], dim=-1)
    centre = H.new_tensor([(n - 1) / 2 for n in cameras.shape[::-1]])[:, None]
    pixels = scale[:, None, None] * (H[:, :2] - centre * across)
    bins = (H[:, 2:3] - middle[:, None, None] * H[:, 3:]) / step[:, None, None]
    return lattice.Lattice(
        (count, *cameras.shape), torch.cat([pixels, bins, H[:, 3:]], dim=1), lift
    )


@dataclass(frozen=True, eq=False)
class Frusta:
    """The frusta of M cameras over one grid; `Frusta.of` makes them.

    Stores images and rows of each camera; values per bin or voxel are computed on access.

    Args:
        frusta_from_world: coordinates of voxels in each frustum, float64.
        world_from_frusta: coordinates of bins in the grid, float64.
        edges: planes between the depth bins in mm, float64.
        voxels: those inside a frustum.
        bins: those inside the grid's box, ahead of the source.
        thickness: mm of depth of a bin.
        slant: mm of ray per mm of depth.
    """

    frusta_from_world: Float[Tensor, "m 1 5 2 3"]
    world_from_frusta: Float[Tensor, "1 m 5 2 3"]
    edges: Float[Tensor, "m e"]
    voxels: lattice.Spans
    bins: lattice.Spans
    thickness: Float[Tensor, "m D"]
    slant: Float[Tensor, "m v u"]

    @classmethod
    def of(cls, grid: Grid, cameras: Cameras, depth: int) -> "Frusta":
        """Build frusta that tightly enclose the visible part of a grid's box.

        Args:
            grid: the region of interest, and the grid of `to_volume`.
            cameras: the rig; its detector's pixels are the frusta's rows and columns.
            depth: number of depth bins.
        """
        edges = lattice.depth_edges(seen_depth_range(cameras, grid), depth)
        world, frusta = lattice.grid_lattice(grid), frusta_lattice(cameras, grid, edges)
        # coordinates of voxels in frusta, and of bins in the grid
        frusta_from_world = lattice.lattice_maps(frusta, world)
        world_from_frusta = lattice.lattice_maps(world, frusta)
        ahead = frusta.ahead[:, None, :, None]
        shape = depth, *cameras.shape
        bins = lattice.enclosed(world_from_frusta[0, :, None], grid.shape, shape)
        start, end = cameras.rays()
        slant = (end - start).norm(dim=-1) / cameras.distance[:, None, None]
        return cls(
            frusta_from_world,
            world_from_frusta,
            edges,
            voxels=lattice.enclosed(frusta_from_world, shape, grid.shape),
            bins=replace(bins, end=bins.end * ahead),
            thickness=(edges[:, 1:] - edges[:, :-1]).abs().float(),
            slant=slant.float(),
        )

    @property
    def shape(self) -> tuple[int, int, int]:
        """Bins (depth, row, column)."""
        return self.bins.shape

    @property
    def step(self) -> Float[Tensor, "m 1 D v u"]:
        """Length in mm of ray in a bin."""
        return (self.thickness[:, :, None, None] * self.slant[:, None])[:, None]

    @property
    def visible(self) -> Bool[Tensor, "m 1 d h w"]:
        """Voxels inside a frustum."""
        return self.voxels.mask

    @property
    def occupied(self) -> Bool[Tensor, "m 1 D v u"]:
        """Bins that may differ from zero: those inside the grid's box, ahead of the source."""
        return self.bins.mask

    @property
    def chord(self) -> Float[Tensor, "m 1 1 v u"]:
        """Length in mm of each ray's occupied bins."""
        return (self.occupied * self.step).sum(dim=-3, keepdim=True)

    def to(self, *where: Any) -> "Frusta":
        """Move to another device or dtype of the steps; the maps stay float64."""
        slant = self.slant.to(*where)
        device = slant.device
        names = ("frusta_from_world", "world_from_frusta", "edges", "voxels", "bins")
        moved = {name: getattr(self, name).to(device) for name in names}
        thickness = self.thickness.to(slant)
        return replace(self, slant=slant, thickness=thickness, **moved)

    def spread(self, views: Float[Tensor, "b c m v u"]) -> Float[Tensor, "b m c D v u"]:
        """Lift views: spread each pixel's integral evenly along its ray's occupied bins."""
        share = self.occupied / self.chord.clamp_min(torch.finfo(views.dtype).tiny)
        return views.transpose(1, 2)[:, :, :, None] * share

    def integrate(self, frusta: Float[Tensor, "b m c D v u"]) -> Float[Tensor, "b c m v u"]:
        """Project each camera's frustum to its own view: the exact sum along every ray."""
        return (frusta * self.step).sum(dim=3).transpose(1, 2)

    def depths(self, like: Tensor) -> Float[Tensor, "D 1 1"]:
        """The depth of each bin, from -1 to 1."""
        ramp = torch.linspace(-1, 1, self.shape[0], device=like.device, dtype=like.dtype)
        return ramp[:, None, None]

    def to_volume(self, frusta: Float[Tensor, "b m c D v u"]) -> Float[Tensor, "b m c d h w"]:
        """Resample each frustum's density at the voxels of the grid; zero outside a frustum."""
        return warp(frusta, self.frusta_from_world, self.voxels.shape)[:, :, 0]

    def to_frusta(self, volumes: Float[Tensor, "b m c d h w"]) -> Float[Tensor, "b m c D v u"]:
        """Resample volumes at the bins of the frusta, one volume for each camera (or one for all, m
        = 1).
        """
        if volumes.shape[1] == 1:
            return warp(volumes, self.world_from_frusta, self.shape)[:, 0]
        return warp(volumes, self.world_from_frusta.transpose(0, 1), self.shape)[:, :, 0]


#: Transmission of bins is clamped to at least this.
LEAST = 0.01


@dataclass(frozen=True, eq=False)
class ViewFrames:
    """The frusta of all cameras, and the maps between them, the volume and the views.

    A frustum holds attenuated density, so its sums along the rays are the camera's view.

    Args:
        frusta: frusta over cells of voxels, with cells of pixels as rows and columns.
        scale: halvings of the grid; cells of 2^scale voxels along each axis.
        binning: pixels of a cell along each axis.
        transmission: share of each bin's emission that reaches the detector; None: no attenuation.
        unit: views per integral of the transmitted density; None: views are line integrals.
        support: cells that touch the support; None: all.
    """

    frusta: Frusta
    scale: int
    binning: int
    transmission: Float[Tensor, "b m 1 D r s"] | None = None
    unit: Float[Tensor, "#b 1 m r s"] | None = None
    support: Float[Tensor, "b 1 e i x"] | None = None

    @classmethod
    def of(cls, g: Geometry, scale: int, binning: int, depths: int) -> "ViewFrames":
        """Build the frames of an operator; frusta are cached for each rig and grid.

        Args:
            g: the operator, SIRT's weights and the support.
            scale: halvings of the grid.
            binning: pixels joined along each axis; fewer if the detector has fewer rows or columns.
            depths: bins along a ray.

        Raises:
            ValueError: explicit rays, which form no image.
        """
        A, like = g.A, g.row
        if not isinstance(A.cameras, Cameras):
            raise ValueError(f"Expected a rig of cameras, got {type(A.cameras).__name__}")
        edge = min(binning, *A.cameras.shape)

        def frusta_of_rig() -> Frusta:
            rows, columns = (n + -n % edge for n in A.cameras.shape)
            cameras = replace(A.cameras, shape=(rows, columns)).binned(edge)
            return Frusta.of(A.grid.coarsened(2**scale), cameras, depths).to(like)

        cut = "frames", scale, edge, depths, like.dtype

        def of_operator() -> tuple[Frusta, Tensor | None]:
            frusta = kept(A.cameras, (cut, grid_key(A.grid), place(like)), frusta_of_rig)
            mu = A.mu_map()
            if mu is None:
                return frusta, None
            mu = mu.detach().to(like)
            mu = mu[None, None] if mu.ndim == 3 else mu[:, None]
            return frusta, transmission(frusta, coarsened(mu, scale))

        frusta, share = kept(A, cut, of_operator)
        frames = cls(frusta, scale, edge, share)
        if g.support is not None:
            support = g.support.to(like)
            touched = _halvings(support, scale, lambda x: F.max_pool3d(x, 2, ceil_mode=True))
            frames = replace(frames, support=touched)
        if kept(A, "views are line integrals", lambda: sees_integrals(A)):
            return frames
        ones = torch.ones_like(g.column[:1]) if g.support is None else g.support.to(like)
        chords = frames.project(frames.to_frames(coarsened(ones, scale)))
        sums = means(divided(1.0, g.row), edge)
        return replace(frames, unit=torch.where(chords > 0, sums / chords.clamp_min(1e-6), 0))

    @property
    def visible(self) -> Bool[Tensor, "m 1 e i x"]:
        """Cells of voxels inside each camera's frustum."""
        return self.frusta.visible

    def to_frames(self, volumes: Float[Tensor, "b *m c e i x"]) -> Float[Tensor, "b m c D r s"]:
        """Resample volumes in each camera's frustum and attenuate: one for all cameras, or one
        each.
        """
        volumes = volumes[:, None] if volumes.ndim == 5 else volumes
        density = self.frusta.to_frusta(volumes) * self.frusta.occupied
        return density if self.transmission is None else density * self.transmission

    def to_volume(self, density: Float[Tensor, "b m c D r s"]) -> Float[Tensor, "b m c e i x"]:
        """Resample the frusta's densities at the cells of the volume, zero outside the support."""
        volumes = self.frusta.to_volume(density)
        return volumes if self.support is None else volumes * self.support[:, None]

    def emitted(self, density: Float[Tensor, "b m 1 D r s"]) -> Float[Tensor, "b m 1 D r s"]:
        """Undo the attenuation of a density."""
        return density if self.transmission is None else density / self.transmission

    def project(self, density: Float[Tensor, "b m 1 D r s"]) -> Float[Tensor, "b 1 m r s"]:
        """Project the density in each camera's frustum to its view, as integrals."""
        return self.frusta.integrate(density)

    def spread(self, integrals: Float[Tensor, "b 1 m r s"]) -> Float[Tensor, "b m 1 D r s"]:
        """Spread integrals evenly along each ray."""
        even = self.frusta.spread(integrals)
        if self.transmission is None:
            return even
        occupied = self.frusta.occupied * self.frusta.step
        passed = (self.transmission * occupied).sum(dim=3, keepdim=True)
        return even * divided(self.frusta.chord, passed)

    def integrals(self, views: Float[Tensor, "b 1 m v u"]) -> Float[Tensor, "b 1 m r s"]:
        """Average views over cells of pixels, as integrals."""
        cells = means(views, self.binning)
        return cells if self.unit is None else divided(cells, self.unit)

    def views(self, integrals: Float[Tensor, "b 1 m r s"]) -> Float[Tensor, "b 1 m r s"]:
        """Convert integrals to the unit of the views."""
        return integrals if self.unit is None else integrals * self.unit

    def mean_along_rays(
        self,
        weights: Float[Tensor, "b m 1 e i x"],
        density: Float[Tensor, "b m 1 e i x"],
        like: Float[Tensor, "b 1 m v u"],
    ) -> Float[Tensor, "b 1 m v u"]:
        """Density-weighted mean of each camera's weights along its rays, for each pixel."""
        pair = torch.cat([density * weights, density], dim=2)
        weighted, equal = self.frusta.to_frusta(pair).sum(dim=3).unbind(2)
        ratio = divided(weighted, equal, 1.0)
        cells = ratio.flatten(0, 1)[:, None].expand(-1, self.binning**2, -1, -1)
        pixels = trimmed(from_cells(cells, self.binning), like.shape[-2:])
        return pixels[:, 0].unflatten(0, ratio.shape[:2])[:, None]


def coarsened(volume: Float[Tensor, "b c d h w"], scale: int) -> Float[Tensor, "b c e i x"]:
    """Means over cells of 2^scale voxels along each axis."""
    return _halvings(volume, scale, halved)


def _halvings(volume: Tensor, scale: int, halve: Callable[[Tensor], Tensor]) -> Tensor:
    for _ in range(scale):
        volume = halve(volume)
    return volume


def means(views: Float[Tensor, "b 1 m v u"], edge: int) -> Float[Tensor, "b 1 m r s"]:
    """The mean over each cell of pixels."""
    pooled = F.avg_pool2d(views.flatten(0, 2), edge, ceil_mode=True)
    return pooled.unflatten(0, views.shape[:3])


def images(views: Float[Tensor, "b k m v u"], edge: int) -> Float[Tensor, "b m c r s"]:
    """Views with cells of pixels as channels."""
    cells = to_cells(padded(views.transpose(1, 2).flatten(0, 1), edge), edge)
    return cells.unflatten(0, (len(views), -1))


@torch.no_grad()
def transmission(frusta: Frusta, mu: Float[Tensor, "b 1 e i x"]) -> Float[Tensor, "b m 1 D r s"]:
    """Return the transmission of each bin: the share of its emission that reaches the detector,
    from `LEAST` to 1.

    A bin is attenuated by itself and by the bins between it and the detector, with emission and
    attenuation constant along the ray: (1 - exp(-mu D)) / (mu D) (Gullberg et al., Phys. Med. Biol.
    30 (1985) 799).

    Convention: photons travel along a ray towards growing w, as in `AttenuatedTransform`: to bins
    of greater index.

    Args:
        frusta: frusta of the rig.
        mu: linear attenuation on their grid, in 1/mm.
    """
    inside = frusta.to_frusta(mu[:, None].to(frusta.slant)) * frusta.occupied * frusta.step
    beyond = inside.flip(3).cumsum(dim=3).flip(3) - inside
    of_bin = torch.where(inside > 0, -torch.expm1(-inside) / inside, 1.0)
    return ((-beyond).exp() * of_bin).clamp_min(LEAST)


def pooled(
    volumes: Float[Tensor, "b m c d h w"], visible: Tensor
) -> tuple[Float[Tensor, "b 1 c d h w"], Float[Tensor, "b 1 c d h w"]]:
    """Mean and variance over the cameras that see a voxel; zero where none does.

    Args:
        volumes: one volume for each camera.
        visible: which voxels each camera sees, [m 1 d h w].
    """
    visibility = visible.to(volumes.dtype)
    count = visibility.sum(dim=0, keepdim=True).clamp_min(1)
    mean = (volumes * visibility).sum(dim=1, keepdim=True) / count
    variance = ((volumes - mean).square() * visibility).sum(dim=1, keepdim=True) / count
    return mean, variance


def leave_one_out(
    volumes: Float[Tensor, "b m c d h w"], visible: Tensor
) -> tuple[Float[Tensor, "b m c d h w"], Float[Tensor, "b m c d h w"], Float[Tensor, "m 1 d h w"]]:
    """For each camera the mean, the variance and the number of the others that see the voxel.

    Sums are taken about the mean over all cameras, to avoid cancellation.
    """
    visibility = visible.to(volumes.dtype)
    centre, _ = pooled(volumes, visible)
    about = (volumes - centre) * visibility
    count = visibility.sum(dim=0, keepdim=True) - visibility
    others = count.clamp_min(1)
    first = (about.sum(dim=1, keepdim=True) - about) / others
    second = (about.square().sum(dim=1, keepdim=True) - about.square()) / others
    counted = count > 0
    variance = (second - first.square()).clamp_min(0)
    return torch.where(counted, first + centre, 0.0), torch.where(counted, variance, 0.0), count


def deviation(variance: Tensor) -> Tensor:
    """The standard deviation, with a finite slope at zero."""
    return (variance + 1e-6).sqrt()


def fuse(
    volumes: Float[Tensor, "b m 1 d h w"], logits: Float[Tensor, "b m 1 d h w"], visible: Tensor
) -> tuple[Float[Tensor, "b 1 d h w"], Float[Tensor, "b m 1 d h w"]]:
    """Weighted mean over the cameras that see a voxel, and its weights; zero where none does.

    Zero logits give the plain mean. Equivariant under permutations of the cameras.
    """
    # finite, not -inf: a voxel that no camera sees must not become NaN
    weights = torch.where(visible, logits, torch.finfo(logits.dtype).min).softmax(dim=1) * visible
    return (weights * volumes).sum(dim=1), weights
