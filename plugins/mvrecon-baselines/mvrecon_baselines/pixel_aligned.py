"""DIF-Net and SVCT: features of the 2-D views, sampled at the projection of every voxel.

Both evaluate all voxels instead of the random points of the publications, and have no data
consistency, as published.
"""

from collections.abc import Mapping, Sequence

import torch
from jaxtyping import Float
from torch import Tensor, nn

from mvrecon.geometry.cameras.camera import Cameras
from mvrecon.geometry.grid import Grid
from mvrecon.methods.learned.geometry import validated
from mvrecon.methods.learned.start import content_scale, nonzero, typical_chord
from mvrecon.methods.learned.unet import PlainUNet, from_cells, trimmed
from mvrecon.methods.method import Reconstruction
from mvrecon.operators.operator import Projector
from mvrecon.operators.voxel_driven import backproject_images, images_of
from mvrecon.training.losses import mean_where

#: Voxels of the grid per voxel of the coarse grid of `Svct`, along each axis.
COARSE = 2
#: The logit of a camera at a voxel outside its view.
UNSEEN = -1e4


def at_voxels(
    features: Float[Tensor, "b m c v u"], cameras: Cameras, grid: Grid
) -> Float[Tensor, "b m c d h w"]:
    """Features of each view at the projected voxel centres, bilinear; zero outside the view."""
    images = images_of(cameras, grid, features)
    each = [
        backproject_images(
            one[:, :, None], images._replace(maps=images.maps[k : k + 1]), weighted=False
        )
        for k, one in enumerate(features.unbind(1))
    ]
    return torch.stack(each, dim=1)


def encoded(
    encoder: nn.Module, views: Float[Tensor, "b 1 m v u"]
) -> tuple[Float[Tensor, "b m c v u"], Float[Tensor, "b 1 1 1 1"]]:
    """Features of each view relative to the scale of all views, and that scale."""
    views = views.contiguous()  # else sums and convolutions are rounded in another order
    scale = content_scale(views)
    images = (views / scale).reshape(-1, 1, *views.shape[3:])
    with torch.autocast(views.device.type, enabled=False):  # logits lose accuracy in half precision
        features = encoder(images)
    return features.unflatten(0, (len(views), -1)), scale * nonzero(views)


class DifNet(nn.Module):
    """DIF-Net: a 2-D U-Net on each view; an MLP maps the maximum of the views' features at every
    voxel to the density, in (unit of the views) / mm.

    Source: Y. Lin, Z. Luo, W. Zhao, X. Li, "Learning deep intensity field for extremely sparse-view
    CBCT reconstruction", MICCAI 2023.

    Args:
        widths: channels of each scale of the 2-D U-Net, the finest first.
        features: channels at the voxels and in the MLP.
    """

    def __init__(self, widths: Sequence[int] = (32, 64, 96), features: int = 32):
        super().__init__()
        self.encoder = PlainUNet(2, 1, features, widths)
        self.point = nn.Sequential(
            nn.Conv3d(features, features, 1),
            nn.SiLU(),
            nn.Conv3d(features, features, 1),
            nn.SiLU(),
            nn.Conv3d(features, 1, 1),
        )

    def forward(self, views: Float[Tensor, "b 1 m v u"], A: Projector) -> Reconstruction:
        y = validated(views, A, self.encoder.first.weight)
        features, scale = encoded(self.encoder, y)
        volume = self.point(at_voxels(features, A.cameras, A.grid).amax(dim=1))
        return Reconstruction(volume * scale / typical_chord(A.grid))


def edges(out: Reconstruction, batch: Mapping[str, Tensor], data_range: float) -> Float[Tensor, ""]:
    """Loss term: mean squared error of the first differences along the three axes, inside a
    method's support, relative to the data range, without a unit.
    """
    error, terms = (out.volume - batch["volume"]) / data_range, []
    for axis in (2, 3, 4):
        pairs = out.support
        if pairs is not None:
            count = pairs.shape[axis] - 1
            pairs = pairs.narrow(axis, 0, count) & pairs.narrow(axis, 1, count)
        terms.append(mean_where(error.diff(dim=axis).square(), pairs))
    return torch.stack(terms).mean()


class Svct(nn.Module):
    """SVCT: a 2-D U-Net on each view; its features on a coarse grid, averaged with softmax weights
    over the views that see a voxel; a 3-D U-Net from these to the fine grid, in (unit of the views)
    / mm.

    Source: Z. Liu and others, "Geometry-aware attenuation learning for sparse-view CBCT
    reconstruction", IEEE TMI 2024, with adaptive fusion. Its loss is the volume loss with
    the term `edges`.

    Args:
        widths: channels of each scale of the 2-D U-Net, the finest first.
        features: channels at the voxels.
        decoder: channels of each scale of the 3-D U-Net, the finest first.
    """

    def __init__(
        self,
        widths: Sequence[int] = (32, 64, 96),
        features: int = 32,
        decoder: Sequence[int] = (32, 48, 64),
    ):
        super().__init__()
        self.encoder = PlainUNet(2, 1, 1 + features, widths)  # the first channel is the logit
        self.decoder = PlainUNet(3, features, COARSE**3, decoder)

    def forward(self, views: Float[Tensor, "b 1 m v u"], A: Projector) -> Reconstruction:
        y = validated(views, A, self.encoder.first.weight)
        features, scale = encoded(self.encoder, y)
        coarse = A.grid.coarsened(COARSE)
        seen = at_voxels(torch.ones_like(features[:, :, :1]), A.cameras, coarse) > 0
        logit, values = at_voxels(features, A.cameras, coarse).tensor_split([1], dim=2)
        weights = torch.where(seen, logit, UNSEEN).softmax(dim=1) * seen
        cells = self.decoder((weights * values).sum(dim=1))
        volume = trimmed(from_cells(cells, COARSE), A.grid.shape)
        return Reconstruction(volume * scale / typical_chord(A.grid))
