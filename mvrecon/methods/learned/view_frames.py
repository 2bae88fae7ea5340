"""Each camera's frame in a learned method: its frustum in coarse bins, and its view in cells of
pixels.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor

from mvrecon.core.division import divided
from mvrecon.geometry.cameras.camera import Cameras
from mvrecon.kernels.device_cache import device_cached, grid_key
from mvrecon.methods.learned.frusta import Frusta
from mvrecon.methods.learned.geometry import Geometry, kept
from mvrecon.methods.learned.unet import from_cells, halved, padded, to_cells, trimmed
from mvrecon.operators.operator import sees_integrals

#: A bin whose transmission is below this share counts as one of this share.
LEAST = 0.01


@dataclass(frozen=True, eq=False)
class ViewFrames:
    """The frusta of all cameras, and the maps between them, the volume and the views.

    A frustum's density is carried with the attenuation behind each bin, so that its sums along the
    rays are what the camera measures.

    Args:
        frusta: over cells of voxels, with cells of pixels as rows and columns.
        scale: halvings of the grid, 2^scale voxels of a cell along each axis.
        binning: pixels of a cell along each axis.
        transmission: share of each bin's emission that reaches the detector; None: nothing
            attenuates.
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
        """The frames of an operator; its frusta are computed once for each rig and grid.

        Args:
            g: the operator, SIRT's weights and the support.
            scale: halvings of the grid.
            binning: pixels joined along each axis; fewer on a detector of fewer rows or columns.
            depths: bins along a ray.

        Raises:
            ValueError: explicit rays, which have no image.
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
            frusta = device_cached(A.cameras, (cut, grid_key(A.grid)), like, frusta_of_rig)
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
        """Volumes in each camera's frustum, attenuated: one for all cameras, or one for each."""
        volumes = volumes[:, None] if volumes.ndim == 5 else volumes
        return self._transmitted(self.frusta.to_frusta(volumes) * self.frusta.occupied)

    def to_volume(self, density: Float[Tensor, "b m c D r s"]) -> Float[Tensor, "b m c e i x"]:
        """Densities of the frusta at the cells of the volume, zero outside the support."""
        volumes = self.frusta.to_volume(density)
        return volumes if self.support is None else volumes * self.support[:, None]

    def emitted(self, density: Float[Tensor, "b m 1 D r s"]) -> Float[Tensor, "b m 1 D r s"]:
        """The density whose attenuated one is given."""
        return density if self.transmission is None else density / self.transmission

    def _transmitted(self, density: Tensor) -> Tensor:
        return density if self.transmission is None else density * self.transmission

    def project(self, density: Float[Tensor, "b m 1 D r s"]) -> Float[Tensor, "b 1 m r s"]:
        """Each camera's view of the density in its own frustum, as integrals."""
        return self.frusta.integrate(density)

    def spread(self, integrals: Float[Tensor, "b 1 m r s"]) -> Float[Tensor, "b m 1 D r s"]:
        """The density, even along each ray, with the given integrals."""
        even = self.frusta.spread(integrals)
        if self.transmission is None:
            return even
        occupied = self.frusta.occupied * self.frusta.step
        passed = (self.transmission * occupied).sum(dim=3, keepdim=True)
        return even * divided(self.frusta.chord, passed)

    def integrals(self, views: Float[Tensor, "b 1 m v u"]) -> Float[Tensor, "b 1 m r s"]:
        """Views in cells of pixels, as integrals."""
        cells = means(views, self.binning)
        return cells if self.unit is None else divided(cells, self.unit)

    def views(self, integrals: Float[Tensor, "b 1 m r s"]) -> Float[Tensor, "b 1 m r s"]:
        """Integrals in the unit of the views."""
        return integrals if self.unit is None else integrals * self.unit

    def mean_along_rays(
        self,
        weights: Float[Tensor, "b m 1 e i x"],
        density: Float[Tensor, "b m 1 e i x"],
        like: Float[Tensor, "b 1 m v u"],
    ) -> Float[Tensor, "b 1 m v u"]:
        """The density-weighted mean of each camera's weights along its rays, one for each pixel."""
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
    """Transmission of each bin: the share of its emission that reaches the detector, from `LEAST`
    to 1.

    A bin is attenuated by those between it and the detector and by itself, with emission and
    attenuation constant along the ray: (1 - exp(-mu D)) / (mu D) (Gullberg et al., Phys. Med. Biol.
    30 (1985) 799).

    Convention: photons travel along a ray towards growing w, as in `AttenuatedTransform`: to bins
    of a greater index.

    Args:
        frusta: of the rig.
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
    """For each camera the mean, the variance and the count of the others that see the voxel.

    Sums are formed about the mean over all cameras, so that the subtraction cancels no digits.
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
    """The weighted mean over the cameras that see a voxel, and its weights; zero where none does.

    Zero logits give the plain mean. The result is equivariant to a permutation of the cameras.
    """
    # Finite, not -inf: a voxel that no camera sees must not turn into NaN.
    weights = torch.where(visible, logits, torch.finfo(logits.dtype).min).softmax(dim=1) * visible
    return (weights * volumes).sum(dim=1), weights
