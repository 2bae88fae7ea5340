"""The pathway by ideal projections: lifted views, a 3-D U-Net, parallel projections of what it
makes, and filtered back-projection of the slices.
"""

from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

import torch
from jaxtyping import Float
from torch import Tensor, nn

from mvrecon.cameras.camera import Cameras
from mvrecon.cameras.sinogram import sinogram_rig
from mvrecon.models.cropping import Cropping
from mvrecon.models.cross_view.evidence import MAGNIFIED
from mvrecon.models.cross_view.unet import PlainUNet, Precision
from mvrecon.models.door import admitted
from mvrecon.models.geometry import Geometry
from mvrecon.models.options import Options
from mvrecon.models.output import Reconstruction
from mvrecon.models.pixel_aligned import at_voxels
from mvrecon.models.sparse_view.filtered import Geometry as Slices
from mvrecon.models.sparse_view.filtered import filtered, in_full_precision
from mvrecon.models.start import ClassicalStart, Start, normalised, typical_chord
from mvrecon.projectors.operator import Projector
from mvrecon.projectors.radon import Radon
from mvrecon.projectors.voxel_driven import images_of
from mvrecon.reconstructors.filtered.filters import Filter

#: Projections of the full circle for each voxel along the longer side of a slice: 256 for 64.
ANGLES = 4
#: Channels between the convolutions of the head.
HEAD = 16


class RadonUNet(nn.Module):
    """Ideal parallel projections by a 3-D U-Net on lifted views, and their filtered
    back-projection, in the unit of (views / mm).

    The U-Net sees the start, its residual back-projected, and each camera's view lifted to the
    voxels (a channel for each camera). It makes volumes of features; the first one is what it adds
    to the start. The Radon transform takes all of them to parallel projections, where a small 2-D
    network, the same for all angles, corrects the first: it can add what the grid's own projections
    lack. Before training the answer is FBP of the start's projections.

    Facing projections are each other's mirror image: those of half a circle are made. The loss term
    `corrected_views` compares them with the truth's own; with `volume: 0` they learn from nothing
    else, with `corrected_views: 0` it is end to end through the back-projection.

    Args:
        projector: holds the grid and the rig.
        angles: projections of the full circle, an even number; None: four times the voxels along
            the longer side of a slice.
        widths: channels of each scale of the 3-D U-Net, the finest first.
        features: volumes that it makes, at least 1.
        start: iterations of SIRT with momentum, the classical start, or a reconstructor as `{name:
            ..., **options}`.
        filter: window of the ramp, as in `fbp`.
        precision: of the U-Net's convolutions, "float32" or "auto".

    Raises:
        ValueError: explicit rays, which have no image; a number of angles that is odd or below 4;
            no feature; a grid whose axes are not at right angles.
    """

    #: Its lifted views are channels.
    counts_cameras = True
    #: What the truth's own projections are made by.
    corrected_projector: ClassVar[Mapping[str, Any]] = {"name": "radon"}

    def __init__(
        self,
        projector: Projector,
        angles: int | None = None,
        widths: Sequence[int] = (16, 32, 64),
        features: int = 4,
        start: Start = 12,
        filter: Filter = "ram-lak",
        precision: Precision = "float32",
    ):
        super().__init__()
        grid, cameras = projector.grid, projector.cameras
        if not isinstance(cameras, Cameras):
            raise ValueError(
                f"Expected a rig of cameras for lifted views, got {type(cameras).__name__}"
            )
        angles = ANGLES * max(grid.shape[1:]) if angles is None else angles
        if angles < 4 or angles % 2 or features < 1:
            raise ValueError(
                f"Expected an even number of angles, at least 4, and one feature or more, got "
                f"{angles} and {features}"
            )
        rig = sinogram_rig(grid, angles)
        self.corrected_cameras = rig[list(range(angles // 2))]
        self.radon = Radon(grid, self.corrected_cameras)
        self.cropping = Cropping(projector, Options())
        self.start = ClassicalStart(start)
        self.filter: Filter = filter
        self.chord = typical_chord(grid)
        inputs = 2 + len(cameras)
        self.net = PlainUNet(3, inputs, features, widths, zero=1, precision=precision)
        self.head = _head(features)

    def forward(self, views: Float[Tensor, "b 1 m v u"]) -> Reconstruction:
        views = admitted(views, self.cropping.cameras, self.net.first.weight)
        geometry = self.cropping.whole
        with in_full_precision(views):
            y, start, scale = normalised(geometry, views, self.start, self.training)
            projections = self.projections(geometry, y, start)
            volume = self.backprojected(projections).clamp_min(0)
        return Reconstruction(
            volume * scale,
            start=start * scale,
            corrected_views=(projections * scale,),
            row=scale.new_full((1, 1, 1, 1, 1), 1 / self.chord),
        )

    def projections(
        self,
        geometry: Geometry,
        views: Float[Tensor, "b 1 m v u"],
        start: Float[Tensor, "b 1 d h w"],
    ) -> Float[Tensor, "b 1 a z s"]:
        """Ideal projections over half a circle, in the unit of the volume times mm."""
        means = (geometry.row * views).transpose(1, 2)
        images = images_of(geometry.A.cameras, geometry.A.grid, means)
        lifted = at_voxels(means, images).squeeze(2)
        residual = MAGNIFIED * geometry.residual(start, views)
        features = self.net(torch.cat([start, residual, lifted], dim=1))
        added, others = features.tensor_split([1], dim=1)
        ideal = self.radon(torch.cat([start + added, others], dim=1))
        images = (ideal / self.chord).transpose(1, 2).flatten(0, 1)
        change = self.head(images).unflatten(0, (len(views), -1)).transpose(1, 2)
        return ideal[:, :1] + self.chord * change

    def backprojected(self, projections: Float[Tensor, "b 1 a z s"]) -> Float[Tensor, "b 1 d h w"]:
        """Filtered back-projection of the slices, in the unit of (projections / mm); linear."""
        slices = Slices(self.radon.grid, self.corrected_cameras)
        return filtered(slices, projections, self.filter)


def _head(features: int) -> nn.Sequential:
    """Three convolutions of projections, whose answer starts at exactly zero."""
    last = nn.Conv2d(HEAD, 1, 3, padding=1)
    for parameter in last.parameters():
        nn.init.zeros_(parameter)
    return nn.Sequential(
        nn.Conv2d(features, HEAD, 3, padding=1),
        nn.SiLU(),
        nn.Conv2d(HEAD, HEAD, 3, padding=1),
        nn.SiLU(),
        last,
    )
