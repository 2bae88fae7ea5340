"""Networks of the literature that read features of 2-D views at the projection of every voxel: the
ideas of DIF-Net and of geometry-aware attenuation learning (SVCT), without their training at random
points.

Neither has a data consistency step, as published. Their weights belong to no rig.
"""

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor, nn

from mvrecon.cameras.camera import Cameras
from mvrecon.geometry.grid import Grid
from mvrecon.models.cross_view.cells import from_cells, trimmed
from mvrecon.models.cross_view.unet import PlainUNet
from mvrecon.models.door import admitted
from mvrecon.models.output import Reconstruction
from mvrecon.models.start import anything, content_scale, typical_chord
from mvrecon.projectors.operator import Projector
from mvrecon.projectors.voxel_driven import Images, images_of, looked

#: Voxels of the grid, along each axis, in one of the coarse grid of `Svct`.
COARSE = 2
#: The logit of a camera that does not see a voxel.
UNSEEN = -1e4


def at_voxels(features: Float[Tensor, "b m c v u"], images: Images) -> Float[Tensor, "b m c d h w"]:
    """Each view's features at the projections of voxels' centres, in their unit; zero where a
    camera sees none.
    """
    views = [
        looked(one[:, :, None], images._replace(maps=images.maps[k : k + 1]), weighted=False)
        for k, one in enumerate(features.unbind(1))
    ]
    return torch.stack(views, dim=1)


class PixelAligned(nn.Module):
    """Features of the views by one 2-D U-Net, brought to the voxels of a grid.

    Args:
        projector: its grid and its rig.
        widths: channels of each scale of the U-Net, the finest first.
        features: channels brought to the voxels.

    Raises:
        ValueError: explicit rays, which have no image.
    """

    def __init__(self, projector: Projector, widths: Sequence[int], features: int):
        super().__init__()
        if not isinstance(projector.cameras, Cameras):
            raise ValueError(
                f"Expected a rig of cameras for features of views, got "
                f"{type(projector.cameras).__name__}"
            )
        self.projector = projector
        self.chord = typical_chord(projector.grid)
        self.encoder = PlainUNet(2, 1, features, widths)

    def forward(self, views: Float[Tensor, "b 1 m v u"]) -> Reconstruction:
        views = admitted(views, self.projector.cameras, self.encoder.first.weight).contiguous()
        scale = content_scale(views)
        images = (views / scale).squeeze(1).flatten(0, 1)[:, None].contiguous()
        with torch.autocast(views.device.type, enabled=False):  # logits suffer in half precision
            features = self.encoder(images).unflatten(0, (len(views), -1))
        volume = self.volume(features) * scale / self.chord
        return Reconstruction(volume=volume * anything(views))

    def volume(self, features: Float[Tensor, "b m c v u"]) -> Float[Tensor, "b 1 d h w"]:
        """The volume relative to the views' scale, from the features of all views."""
        raise NotImplementedError

    def at_voxels(
        self, features: Float[Tensor, "b m c v u"], grid: Grid
    ) -> Float[Tensor, "b m c d h w"]:
        """Each view's features at the projections of voxels' centres; zero where it sees none."""
        return at_voxels(features, images_of(self.projector.cameras, grid, features))


class DifNet(PixelAligned):
    """Pixel-aligned features, the largest of all views, and an MLP at every voxel give its density,
    in the unit of (views / mm).

    Source: Y. Lin, Z. Luo, W. Zhao, X. Li, "Learning deep intensity field for extremely sparse-view
    CBCT reconstruction", MICCAI 2023; there points at random, here all voxels.

    Args:
        projector: its grid and its rig.
        widths: channels of each scale of the 2-D U-Net, the finest first.
        features: channels brought to the voxels, and of the MLP.

    Raises:
        ValueError: explicit rays, which have no image.
    """

    def __init__(
        self, projector: Projector, widths: Sequence[int] = (32, 64, 96), features: int = 32
    ):
        super().__init__(projector, widths, features)
        self.point = nn.Sequential(
            nn.Conv3d(features, features, 1),
            nn.SiLU(),
            nn.Conv3d(features, features, 1),
            nn.SiLU(),
            nn.Conv3d(features, 1, 1),
        )

    def volume(self, features: Float[Tensor, "b m c v u"]) -> Float[Tensor, "b 1 d h w"]:
        """The MLP's density from the largest of the views' features at every voxel."""
        return self.point(self.at_voxels(features, self.projector.grid).amax(dim=1))


class Svct(PixelAligned):
    """Features of the views in a coarse grid, weighed by a softmax over the views that see a voxel,
    and a 3-D U-Net that leads to the fine grid, in the unit of (views / mm).

    Source: Z. Liu and others, "Geometry-aware attenuation learning for sparse-view CBCT
    reconstruction", IEEE TMI 2024; its adaptive fusion. Its loss is that of volumes with
    `loss.edges`.

    Args:
        projector: its grid and its rig.
        widths: channels of each scale of the 2-D U-Net, the finest first.
        features: channels brought to the voxels.
        decoder: channels of each scale of the 3-D U-Net, the finest first.

    Raises:
        ValueError: explicit rays, which have no image.
    """

    def __init__(
        self,
        projector: Projector,
        widths: Sequence[int] = (32, 64, 96),
        features: int = 32,
        decoder: Sequence[int] = (32, 48, 64),
    ):
        super().__init__(projector, widths, features + 1)
        self.coarse = projector.grid.coarsened(COARSE)
        self.decoder = PlainUNet(3, features, COARSE**3, decoder)

    def volume(self, features: Float[Tensor, "b m c v u"]) -> Float[Tensor, "b 1 d h w"]:
        """The decoder's density from the fused features; the first channel of each view is its
        logit.
        """
        seen = self.at_voxels(torch.ones_like(features[:, :, :1]), self.coarse) > 0
        logit, values = self.at_voxels(features, self.coarse).tensor_split([1], dim=2)
        weight = torch.where(seen, logit, UNSEEN).softmax(dim=1) * seen
        cells = self.decoder((weight * values).sum(dim=1))
        return trimmed(from_cells(cells, COARSE), self.projector.grid.shape)
