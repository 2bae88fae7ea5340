"""From views to the region that is worked on: the support, its crop, and that crop's geometry."""

from collections import OrderedDict
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from mvrecon.cameras.camera import Cameras
from mvrecon.geometry.box import Box
from mvrecon.models.geometry import MULTIPLE, Geometry, crop_of, whole_geometry
from mvrecon.models.region import Region
from mvrecon.models.skip import Skip
from mvrecon.models.window import held_bricks
from mvrecon.projectors.operator import Projector
from mvrecon.reconstruct.iterative import inverse_sums
from mvrecon.visual_hull.support import WORTH, support_from_views

#: Crops whose geometry is kept; a fixed rig's scenes share few.
KEPT = 8


class Regions(nn.Module):
    """Tells the region of a batch; keeps the geometry of the grid, and of the crops asked for last.

    Args:
        projector: A.
        skip: what is skipped.
        binning: of the coarse frusta's pixels, where a model has any.
    """

    def __init__(self, projector: Projector, skip: Skip, binning: int | None = None):
        super().__init__()
        self.whole = whole_geometry(projector, binning)
        self.skip = skip
        self.crops: OrderedDict[Any, Geometry] = OrderedDict()

    @property
    def cameras(self) -> Cameras:
        """The whole rig."""
        return self.whole.projector.cameras

    def forward(self, views: Float[Tensor, "b 1 m v u"]) -> Region:
        """The region of views."""
        A, skip = self.whole.projector, self.skip
        everything = Region(
            self.whole, A.grid.shape, len(A.cameras), (self.whole.row, self.whole.column)
        )
        if skip.support == "none":
            return everything
        found = support_from_views(views, A.cameras, A.grid, "hull", skip.noise)
        assert found.mask is not None  # a hull has a mask
        mask = torch.cat([worked_on(one, skip.support) for one in found.mask.split(1)])
        box = Box.around(mask)
        box = (
            (box if box.size else found.box)
            .grown(skip.margin, A.grid.shape)
            .aligned(MULTIPLE, A.grid.shape)
        )
        mask = mask[..., *box.slices]
        geometry = self.crop(box, held_bricks(mask) if skip.masked else None)
        weights = masked_weights(geometry, mask, views.dtype)
        return Region(geometry, A.grid.shape, len(A.cameras), weights, box, mask, skip.masked)

    def crop(self, box: Box, bricks: Bool[Tensor, "z y x"] | None = None) -> Geometry:
        """The geometry of a crop, or of some bricks of it, made at most once while it is kept."""
        told = None if bricks is None else bricks.cpu().numpy().tobytes()
        key = box, told, self.whole.row.device, self.whole.row.dtype
        if key not in self.crops:
            self.crops[key] = crop_of(self.whole, box, bricks)
        self.crops.move_to_end(key)
        while len(self.crops) > KEPT:
            self.crops.popitem(last=False)
        return self.crops[key]


def masked_weights(
    geometry: Geometry, mask: Bool[Tensor, "b 1 d h w"], dtype: torch.dtype
) -> tuple[Tensor, Tensor]:
    """SIRT's (R, C) of the operator A diag(M), for each sample: R from rays through the mask, C
    zero outside it.
    """
    with torch.no_grad():
        rows = geometry.projector(mask.to(dtype))
    return torch.cat([inverse_sums(own) for own in rows.split(1)]), geometry.column * mask


def worked_on(hull: Bool[Tensor, "1 1 d h w"], kind: str) -> Bool[Tensor, "1 1 d h w"]:
    """A sample's mask: its "hull", that hull's "box", or by "auto" the hull if its box is small,
    else everything.

    A sample is asked alone, so that it does not matter with which others it is in a batch.
    """
    box = Box.around(hull)
    if kind == "hull" or (kind == "auto" and box.size < WORTH * hull.numel()):
        return hull
    mask = torch.full_like(hull, kind == "auto")
    mask[..., *box.slices] = True
    return mask
