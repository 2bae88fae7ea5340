"""Where one batch is worked on: a crop of the grid, and the voxels of each sample that may hold
anything.

Convention: inside a model every volume is the crop's; only what a model returns has the shape of
the grid.
"""

from dataclasses import dataclass
from functools import cached_property

from jaxtyping import Bool, Float, Shaped
from torch import Tensor
from torch.nn.functional import adaptive_max_pool3d

from mvrecon.geometry.box import Box, placed
from mvrecon.models.bins import Bins, SomeBins
from mvrecon.models.geometry import MULTIPLE, Geometry
from mvrecon.projectors.operator import Projector
from mvrecon.reconstruct.iterative import correction


@dataclass(frozen=True, eq=False)
class Region:
    """A geometry, and what of it counts.

    Args:
        geometry: of the crop.
        shape: voxels of the whole grid.
        cameras: of the whole rig; those that see nothing of the crop are left out, which changes
            nothing.
        weights: SIRT's (R, C); C is zero outside the mask and R is made of rays through it.
        box: the crop; none for the whole grid.
        mask: where the density may differ from zero; none for everywhere.
        seen_by_nets: whether the mask belongs to the networks' definition.
    """

    geometry: Geometry
    shape: tuple[int, int, int]
    cameras: int
    weights: tuple[Tensor, Tensor]
    box: Box | None = None
    mask: Bool[Tensor, "b 1 d h w"] | None = None
    seen_by_nets: bool = False

    @property
    def A(self) -> Projector:
        """The operator between the crop and the views."""
        return self.geometry.projector

    @cached_property
    def net_mask(self) -> Bool[Tensor, "b 1 d h w"] | None:
        """The mask of the world's networks; none where one of ones would change nothing, and take
        longer.
        """
        if not self.seen_by_nets or self.mask is None:
            return None
        plain = self.mask.all() and not any(size % MULTIPLE for size in self.mask.shape[2:])
        return None if plain else self.mask

    def measured(self, views: Float[Tensor, "b c m v u"]) -> Float[Tensor, "b c k v u"]:
        """The views of the cameras that see the crop."""
        return views[:, :, self.geometry.views] if self.culled else views

    @property
    def culled(self) -> int:
        """How many cameras see nothing of the crop, and are left out."""
        return self.cameras - len(self.geometry.views)

    def of_all(
        self, values: Shaped[Tensor, "b k *n"], otherwise: Shaped[Tensor, "b 1 *n"] | None = None
    ) -> Tensor:
        """Values of the cameras that see the crop among the whole rig's; zero for the others, or as
        given.
        """
        if not self.culled:
            return values
        size = [len(values), self.cameras, *values.shape[2:]]
        whole = values.new_zeros(size) if otherwise is None else otherwise.expand(size)
        return whole.index_copy(1, self.geometry.views, values)

    def back(self, residual: Float[Tensor, "b c m v u"]) -> Float[Tensor, "b c d h w"]:
        """Residual views as a correction of the volume, C A^T R r."""
        return correction(self.A, residual, self.weights)

    def residual(
        self, volume: Float[Tensor, "b c d h w"], views: Float[Tensor, "b c m v u"]
    ) -> Float[Tensor, "b c d h w"]:
        """How each voxel should change for the views to be met: C A^T R (y - A x), in the unit of
        x.
        """
        return self.back(views - self.A(volume))

    def within(self, volume: Float[Tensor, "b *m c d h w"]) -> Float[Tensor, "b *m c d h w"]:
        """Volumes, zero outside the mask."""
        if self.mask is None:
            return volume
        return volume * (self.mask if volume.ndim == 5 else self.mask[:, None])

    def seen(self) -> Bool[Tensor, "*b m 1 d h w"]:
        """Which voxels that may hold anything each camera sees."""
        visible = self.geometry.fine.visible
        return visible if self.mask is None else visible & self.mask[:, None]

    def bins(self) -> tuple[Bins, Bins]:
        """Fine and coarse bins; with a mask, those alone that may hold anything of it."""
        fine, coarse = self.geometry.fine, self.geometry.coarse
        if self.mask is None:
            return fine, coarse
        touched = fine.touched(self.mask)
        held = adaptive_max_pool3d(touched.flatten(0, 1).to(fine.step.dtype), coarse.shape) > 0
        held = held.unflatten(0, touched.shape[:2])
        return SomeBins(fine.occupied & touched, fine.step), SomeBins(
            coarse.occupied & held, coarse.step
        )

    def pasted(self, volume: Float[Tensor, "*b d h w"]) -> Float[Tensor, "*b D H W"]:
        """A volume of the crop in zeros of the whole grid."""
        return volume if self.box is None else placed(volume, self.box, self.shape)

    @property
    def support(self) -> Bool[Tensor, "b 1 D H W"] | None:
        """The mask on the whole grid."""
        return None if self.mask is None else self.pasted(self.mask)
