"""The views of a rig as a cameras' network sees them: cells of pixels as channels."""

from dataclasses import replace
from typing import NamedTuple

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor

from mvrecon.cameras.camera import Cameras
from mvrecon.models.cross_view.cells import from_cells, padded, to_cells, trimmed
from mvrecon.models.cross_view.evidence import MAGNIFIED, SMALL, Evidence
from mvrecon.projectors.operator import Projector

#: Images of one camera: its residual, its view, and the sharp part of that.
IMAGES = 3


class Binned(NamedTuple):
    """A rig whose detector pixels are joined into cells, the last ones partly beyond the detector.

    Args:
        cameras: with cells as pixels.
        edge: of a cell along each axis, in pixels.
    """

    cameras: Cameras
    edge: int

    @classmethod
    def of(cls, projector: Projector, binning: int) -> "Binned":
        """The rig of a projector in cells of `binning` pixels along each axis, of fewer where the
        detector has fewer rows or columns: so weights fit a detector of any other size.

        Raises:
            ValueError: explicit rays, which have no image.
        """
        cameras = projector.cameras
        if not isinstance(cameras, Cameras):
            raise ValueError(
                f"Expected a rig of cameras for a cameras' network, got {type(cameras).__name__}"
            )
        rows, columns = cameras.shape
        edge = min(binning, rows, columns)
        whole = rows + -rows % edge, columns + -columns % edge
        return cls(replace(cameras, shape=whole).binned(edge), edge)


def image_cells(evidence: Evidence, edge: int) -> Float[Tensor, "b m k r s"]:
    """Residual, view, and view less its mean over 3 x 3 pixels, with cells as channels."""
    measured = evidence.measured.squeeze(1)
    mean = F.avg_pool2d(measured, 3, stride=1, padding=1, count_include_pad=False)
    residual = MAGNIFIED * evidence.residual.squeeze(1)
    views = torch.stack([residual, measured, MAGNIFIED * (measured - mean)], dim=2)
    return to_cells(padded(views.flatten(0, 1), edge), edge).unflatten(0, measured.shape[:2])


def among_counts(counts: Float[Tensor, "b 1 m v u"]) -> Bool[Tensor, "b 1 m v u"]:
    """Whether a pixel counted anything, or most of the 3 x 3 about it did.

    Beside the object most pixels are empty; in its image, where one count a pixel is expected,
    less than half by Poisson's law.
    """
    filled = (counts > 0).to(counts.dtype)
    share = F.avg_pool2d(filled.flatten(0, 2), 3, stride=1, padding=1, count_include_pad=False)
    return (filled > 0) | (share.reshape(counts.shape) > 0.5)


def correction_of(
    cells: Float[Tensor, "n k r s"], edge: int, like: Float[Tensor, "b 1 m v u"]
) -> Float[Tensor, "b 1 m v u"]:
    """The correction of every view, from the cells of all cameras, in the size of `like`."""
    views = trimmed(from_cells(cells, edge), like.shape[-2:])
    return SMALL * views.unflatten(0, (len(like), -1)).transpose(1, 2)


def means(views: Float[Tensor, "b 1 m v u"], edge: int) -> Float[Tensor, "b 1 m r s"]:
    """The views at a detector of cells: the mean of each cell's pixels."""
    if edge == 1:
        return views
    pooled = F.avg_pool2d(views.flatten(0, 2), edge, ceil_mode=True)
    return pooled.unflatten(0, views.shape[:3])


def pixels(
    cells: Float[Tensor, "b 1 m r s"], edge: int, like: Float[Tensor, "b 1 m v u"]
) -> Float[Tensor, "b 1 m v u"]:
    """The value of each pixel's cell, for views in the size of `like`."""
    values = cells.flatten(0, 2)[:, None].expand(-1, edge**2, -1, -1)
    views = trimmed(from_cells(values, edge), like.shape[-2:])
    return views[:, 0].unflatten(0, cells.shape[:3])
