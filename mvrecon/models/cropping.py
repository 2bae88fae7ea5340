"""A network on a crop of the grid: the support that the views tell, its box, the geometry of that
box, and the answer pasted into the whole grid.
"""

from collections import OrderedDict
from collections.abc import Callable
from typing import Any

import torch
from jaxtyping import Bool, Float, Shaped
from torch import Tensor, nn

from mvrecon.cameras.camera import Cameras
from mvrecon.geometry.box import Box, bounds, filled, placed
from mvrecon.models.crops import cropped_geometry, occupied_bricks
from mvrecon.models.geometry import Geometry, changes_nothing, whole_geometry
from mvrecon.models.networks import MULTIPLE
from mvrecon.models.options import Options
from mvrecon.models.output import Reconstruction
from mvrecon.projectors.operator import Projector
from mvrecon.visual_hull.support import WORTH, hull_mask, middle

#: Crops whose geometry is kept; a fixed rig's scenes share few.
KEPT = 8

#: A network: from the views of a geometry's cameras to volumes of that geometry.
Network = Callable[[Float[Tensor, "b 1 m v u"], Geometry], Reconstruction]


class Cropping(nn.Module):
    """Calls a network on the whole grid's geometry or, if `options` ask for a support, on that of a
    crop around it. Keeps the geometry of the grid, and of the last crops.

    Args:
        projector: A.
        options: support, noise, halo and masked count here.
        binning: of the coarse frusta's pixels; none for a model without frusta.
    """

    def __init__(self, projector: Projector, options: Options, binning: int | None = None):
        super().__init__()
        self.projector = projector  # a module of its own, so that it moves with the model
        self.options = options
        self.whole = whole_geometry(projector, binning)
        self.crops: OrderedDict[Any, Geometry] = OrderedDict()

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> "Cropping":
        super()._apply(fn, recurse)
        self.whole = self.whole.to(fn(self.whole.row))
        return self

    @property
    def cameras(self) -> Cameras:
        """The whole rig."""
        return self.projector.cameras

    def forward(self, views: Float[Tensor, "b 1 m v u"], network: Network) -> Reconstruction:
        """What the network makes of views, on the whole grid; zero outside the support.

        Cameras that see nothing of a crop are left out: their weights would be zero.
        """
        if self.options.support == "none":
            return network(views, self.whole)
        geometry, box = self.region(views)
        if len(geometry.cameras) < len(self.cameras):
            views = views[:, :, geometry.cameras]
        return self._pasted(network(views, geometry), geometry, box)

    def region(self, views: Float[Tensor, "b 1 m v u"]) -> tuple[Geometry, Box]:
        """The crop around the support of views, with the support as its mask, and where it lies."""
        options, shape = self.options, self.projector.grid.shape
        mask = self.mask(views)
        on_host = mask.cpu()  # once for all sizes: for each number the host would wait for a GPU
        box = Box.around(on_host)
        box = box if box.size else middle(self.projector.grid)
        box = box.grown(options.margin, shape).aligned(MULTIPLE, shape)
        mask, on_host = mask[..., *box.slices], on_host[..., *box.slices]
        masked = options.masked and not changes_nothing(on_host)
        crop = self.crop(box, occupied_bricks(on_host) if options.masked else None)
        return crop.with_mask(mask, masked), box

    def mask(self, views: Float[Tensor, "b 1 m v u"]) -> Bool[Tensor, "b 1 d h w"]:
        """The support of views on the whole grid, for which a GPU is not waited for."""
        grid, noise = self.projector.grid, self.options.noise
        return support_of(hull_mask(views, self.cameras, grid, noise), self.options.support)

    def crop(self, box: Box, bricks: Bool[Tensor, "z y x"] | None = None) -> Geometry:
        """The geometry of a crop, or of some bricks of it, made at most once while it is kept."""
        pattern = None if bricks is None else bricks.cpu().numpy().tobytes()
        key = box, pattern, self.whole.row.device, self.whole.row.dtype
        if key not in self.crops:
            # training may use a crop that evaluation has made
            with torch.inference_mode(False), torch.no_grad():
                self.crops[key] = cropped_geometry(self.whole, box, bricks)
        self.crops.move_to_end(key)
        while len(self.crops) > KEPT:
            self.crops.popitem(last=False)
        return self.crops[key]

    def _pasted(self, out: Reconstruction, crop: Geometry, box: Box) -> Reconstruction:
        """A crop's volumes in zeros of the whole grid, its cameras among all of the rig. The
        opinion of a camera that was left out is the start.
        """
        shape, n_cameras = self.projector.grid.shape, len(self.cameras)

        def in_grid(volume: Tensor | None) -> Tensor | None:
            return None if volume is None else placed(volume, box, shape)

        def in_rig(values: Tensor | None, otherwise: Tensor | None = None) -> Tensor | None:
            return None if values is None else among(values, crop.cameras, n_cameras, otherwise)

        def in_views(views: Tensor | None) -> Tensor | None:
            views = in_rig(None if views is None else views.transpose(1, 2))
            return None if views is None else views.transpose(1, 2)

        start = None if out.start is None else out.start[:, None]
        return Reconstruction(
            volume=placed(out.volume, box, shape),
            opinions=in_grid(in_rig(out.opinions, start)),
            visible=None if out.visible is None else self.whole.fine.visible,
            weights=in_grid(in_rig(out.weights)),
            cross_views=in_views(in_rig(out.cross_views, out.start_views)),
            support=in_grid(crop.mask),
            start=in_grid(out.start),
            start_views=in_views(out.start_views),
        )


def among(
    values: Shaped[Tensor, "b k *n"],
    index: Tensor,
    count: int,
    otherwise: Shaped[Tensor, "b 1 *n"] | None = None,
) -> Shaped[Tensor, "b m *n"]:
    """Values of some cameras among those of all; zero for the others, or as given."""
    if len(index) == count:
        return values
    size = [len(values), count, *values.shape[2:]]
    whole = values.new_zeros(size) if otherwise is None else otherwise.expand(size)
    return whole.index_copy(1, index, values)


def support_of(hull: Bool[Tensor, "b 1 d h w"], kind: str) -> Bool[Tensor, "b 1 d h w"]:
    """Each sample's mask: its visual "hull", that hull's "box", or by "auto" the hull if its box is
    small, else the whole grid.
    """
    if kind == "hull":
        return hull
    box = filled(bounds(hull[:, 0]), hull.shape[2:])[:, None]
    if kind == "box":
        return box
    small = box.flatten(1).sum(dim=1) < WORTH * hull[0].numel()
    return hull | ~small.view(-1, 1, 1, 1, 1)
