"""What a network knows of the grid and the rig: the operator A, SIRT's weights, the cameras'
frusta, and a mask.

Convention: inside a network every volume has the geometry's shape, be it the whole grid or a crop.
"""

from dataclasses import dataclass, replace
from typing import Any

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn.functional import adaptive_max_pool3d

from mvrecon.models.frusta import Frusta
from mvrecon.models.networks import MULTIPLE
from mvrecon.projectors.operator import Projector
from mvrecon.reconstructors.division import divided
from mvrecon.reconstructors.iterative import (
    SirtWeights,
    correction,
    inverse_sums,
    sirt_weights,
)

#: A chord counts as at least this part of the longest.
SHORTEST = 0.1


@dataclass(frozen=True, eq=False)
class Geometry:
    """An operator, its weights and its cameras' frusta; all that a network asks of them.

    Args:
        A: the operator between volumes and views.
        row: R, the inverse row sums of A (SIRT), in 1/mm.
        column: C, the inverse column sums, zero outside the mask.
        cameras: which of the rig's cameras A has; a crop leaves out those that see nothing of it.
        frusta: (of the detectors' own pixels, of binned pixels and bins twice as deep); none for a
            model without opinions.
        mask: voxels whose density may differ from zero; none for all.
        masked: whether the networks know the mask: their features are zero outside it.
    """

    A: Projector
    row: Float[Tensor, "#b 1 m v u"]
    column: Float[Tensor, "#b 1 d h w"]
    cameras: Int[Tensor, " m"]
    frusta: tuple[Frusta, Frusta] | None = None
    mask: Bool[Tensor, "b 1 d h w"] | None = None
    masked: bool = False

    @property
    def fine(self) -> Frusta:
        """Frusta of the detectors' own pixels."""
        return self._pair[0]

    @property
    def coarse(self) -> Frusta:
        """Frusta of binned pixels and bins twice as deep."""
        return self._pair[1]

    @property
    def _pair(self) -> tuple[Frusta, Frusta]:
        if self.frusta is None:
            raise ValueError("This geometry was made without frusta")
        return self.frusta

    @property
    def network_mask(self) -> Bool[Tensor, "b 1 d h w"] | None:
        """The mask for the networks in the world, if they know it."""
        return self.mask if self.masked else None

    @property
    def visible(self) -> Bool[Tensor, "*b m 1 d h w"]:
        """Which voxels of the mask each camera sees."""
        visible = self.fine.visible
        return visible if self.mask is None else visible & self.mask[:, None]

    @property
    def weights(self) -> SirtWeights:
        """R and C of SIRT."""
        return SirtWeights(self.row, self.column)

    @property
    def bounded_row(self) -> Float[Tensor, "#b 1 m v u"]:
        """R with chords that count as at least `SHORTEST` of the longest: where views err, rays
        that graze the region measure more than their chords explain.
        """
        of_longest = torch.where(self.row > 0, self.row, torch.inf).amin((1, 2, 3, 4), True)
        return self.row.minimum(of_longest / SHORTEST)

    @property
    def bounded_sums(self) -> Float[Tensor, "#b 1 m v u"]:
        """Views of ones, none of which is very small, and zero where no ray meets the region."""
        row = self.bounded_row
        return divided(1.0, row)

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

    def with_mask(self, mask: Bool[Tensor, "b 1 d h w"], masked: bool) -> "Geometry":
        """The geometry of A diag(M), for each sample: R from rays through the mask, C zero outside
        it, and in the frusta the bins that touch it.
        """
        with torch.no_grad():
            sums = self.A(mask.to(self.row.dtype))
        row = torch.cat([inverse_sums(own) for own in sums.split(1)])
        column, frusta = self.column * mask, self.frusta
        if frusta is not None:
            frusta = _touching(*frusta, mask)
        return replace(self, row=row, column=column, frusta=frusta, mask=mask, masked=masked)

    def to(self, *where: Any) -> "Geometry":
        """On another device, or with weights of another dtype; A moves by itself."""
        row = self.row.to(*where)
        column, cameras = self.column.to(row), self.cameras.to(row.device)
        frusta = None if self.frusta is None else (self.fine.to(row), self.coarse.to(row))
        return replace(self, row=row, column=column, cameras=cameras, frusta=frusta)


def changes_nothing(mask: Bool[Tensor, "b 1 d h w"]) -> bool:
    """Whether networks do the same without a mask, and take less time: one of ones, of sizes that
    all of their scales halve.
    """
    return bool(mask.all()) and not any(size % MULTIPLE for size in mask.shape[2:])


def whole_geometry(A: Projector, binning: int | None = None) -> Geometry:
    """The geometry of an operator's own grid.

    Args:
        A: the operator.
        binning: detector pixels joined, along each axis, in the coarse frusta; none for no frusta.
    """
    row, column = sirt_weights(A)
    cameras = torch.arange(len(A.cameras), device=row.device)
    if binning is None:
        return Geometry(A, row, column, cameras)
    depth = max(A.grid.shape)
    fine = Frusta.of(A.grid, A.cameras, depth)
    coarse = Frusta.of(A.grid, A.cameras.binned(binning), max(1, depth // 2))
    return Geometry(A, row, column, cameras, (fine, coarse))


def _touching(
    fine: Frusta, coarse: Frusta, mask: Bool[Tensor, "b 1 d h w"]
) -> tuple[Frusta, Frusta]:
    touched = fine.touched(mask)
    pooled = adaptive_max_pool3d(touched.flatten(0, 1).to(fine.slant.dtype), coarse.shape) > 0
    pooled = pooled.unflatten(0, touched.shape[:2])
    return replace(fine, touching=touched), replace(coarse, touching=pooled)
