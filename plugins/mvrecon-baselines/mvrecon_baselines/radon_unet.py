"""A 3-D U-Net on lifted views, ideal parallel projections of its output, and filtered
back-projection of the slices.
"""

from collections.abc import Sequence
from typing import get_args

import torch
from jaxtyping import Float
from torch import Tensor, nn

from mvrecon.core.registry import check_choice
from mvrecon.geometry.cameras.rigs import sinogram_rig
from mvrecon.geometry.grid import Grid
from mvrecon.methods.classical.fdk import Filter
from mvrecon.methods.learned.cross_view import RESIDUAL_GAIN
from mvrecon.methods.learned.geometry import Geometry, geometry_of, validated
from mvrecon.methods.learned.start import ClassicalStart, Start, normalised, typical_chord
from mvrecon.methods.learned.unet import PlainUNet, Precision
from mvrecon.methods.method import Reconstruction
from mvrecon.operators.memo import kept
from mvrecon.operators.operator import Projector
from mvrecon.operators.radon import Radon
from mvrecon_baselines.pixel_aligned import at_voxels
from mvrecon_baselines.sparse_view import CompletedViews, filtered, full_precision

#: Projections over the full circle per voxel along the longer side of a slice: 256 for 64.
ANGLES = 4
#: Channels between the convolutions of the head.
HEAD = 16


class RadonUNet(nn.Module):
    """Ideal parallel projections by a 3-D U-Net on lifted views, and their filtered
    back-projection, in (unit of the views) / mm.

    The inputs of the U-Net are the initial volume, its back-projected residual, and each view
    lifted to the voxels, one channel per camera. Its first output is added to the initial volume;
    the others are features. The Radon transform maps all outputs to parallel projections, where a
    small 2-D network, shared by all angles, corrects the first: it can restore what projections of
    a voxel grid cannot represent. Before training, the volume is the FBP of the projections of the
    initial volume.

    The loss term `completed_views` compares the projections with those of the truth. With `volume:
    0` it is the only loss; without the term, training is end to end through the back-projection.
    Supports any grid with orthogonal axes.

    Args:
        n_cameras: number of views; their order matters.
        angles: number of projections over the full circle, even; only half are computed since
            opposite projections are mirror images. None: four times the voxels along the longer
            side of a slice.
        widths: channels of each scale of the 3-D U-Net, the finest first.
        features: number of output volumes of the U-Net, at least 1.
        start: iterations of SIRT with momentum, or name and options of a classical method, for the
            initial volume.
        filter: window of the ramp, as in `fbp`.
        precision: precision of the U-Net's convolutions.

    Raises:
        ValueError: an odd number of angles or fewer than 4, no feature, or an unknown filter or
            precision.
    """

    def __init__(
        self,
        n_cameras: int,
        angles: int | None = None,
        widths: Sequence[int] = (16, 32, 64),
        features: int = 4,
        start: Start = 12,
        filter: Filter = "ram-lak",
        precision: Precision = "auto",
    ):
        super().__init__()
        if features < 1 or (angles is not None and (angles < 4 or angles % 2)):
            raise ValueError(
                f"Expected an even number of angles, at least 4, and one feature or more, got "
                f"{angles} and {features}"
            )
        self.n_cameras, self.angles = n_cameras, angles
        self.start = ClassicalStart(start)
        check_choice("filter", filter, get_args(Filter))
        self.filter: Filter = filter
        self.net = PlainUNet(3, 2 + n_cameras, features, widths, zero=1, precision=precision)
        self.head = nn.Sequential(
            nn.Conv2d(features, HEAD, 3, padding=1),
            nn.SiLU(),
            nn.Conv2d(HEAD, HEAD, 3, padding=1),
            nn.SiLU(),
            nn.Conv2d(HEAD, 1, 3, padding=1),
        )
        for parameter in self.head[-1].parameters():
            nn.init.zeros_(parameter)

    def forward(self, views: Float[Tensor, "b 1 m v u"], A: Projector) -> Reconstruction:
        if len(A.cameras) != self.n_cameras:
            raise ValueError(f"Expected {self.n_cameras} cameras, got {len(A.cameras)}")
        y = validated(views, A, self.net.first.weight)
        g = geometry_of(y, A)
        radon = kept(
            A, ("radon", self.angles), lambda: half_circle(A.grid, self.angles).to(A.device)
        )
        with full_precision(y):
            y, start, scale = normalised(g, y, self.start, self.training)
            projections = self.projections(g, radon, y, start)
            volume = filtered(radon, projections, self.filter).clamp_min(0)
        return CompletedViews(
            volume * scale, start=start * scale, completed=projections * scale, dense=radon
        )

    def projections(
        self,
        g: Geometry,
        radon: Radon,
        views: Float[Tensor, "b 1 m v u"],
        start: Float[Tensor, "b 1 d h w"],
    ) -> Float[Tensor, "b 1 a z s"]:
        """Ideal projections over half a circle, in (unit of the volume) * mm."""
        lifted = at_voxels((g.row * views).transpose(1, 2), g.A.cameras, g.A.grid).squeeze(2)
        residual = RESIDUAL_GAIN * g.direction(views - g.A(start))
        volumes = self.net(torch.cat([start, residual, lifted], dim=1))
        ideal = radon(torch.cat([start + volumes[:, :1], volumes[:, 1:]], dim=1))
        chord = typical_chord(g.A.grid)
        change = self.head((ideal / chord).transpose(1, 2).flatten(0, 1))
        return ideal[:, :1] + chord * change.unflatten(0, (len(views), -1)).transpose(1, 2)


def half_circle(grid: Grid, angles: int | None = None) -> Radon:
    """The Radon transform of a grid's slices over half a circle.

    Args:
        grid: the slices.
        angles: number over the full circle; None: `ANGLES` per voxel along the longer side of a
            slice.

    Raises:
        ValueError: a grid whose axes are not orthogonal.
    """
    angles = ANGLES * max(grid.shape[1:]) if angles is None else angles
    return Radon(grid, sinogram_rig(grid, angles)[list(range(angles // 2))])
