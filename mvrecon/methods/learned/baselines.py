"""Learned baselines: a 3-D U-Net on a classical reconstruction, a network without camera geometry,
and the mean of per-view estimates.

A network on volumes is built by name as `Network(inputs, outputs, **options)` and maps volumes [n
inputs d h w] to [n outputs d h w] of the same size. An optional attribute `multiple` is the number
of voxels that must divide its sizes.
"""

from collections.abc import Sequence

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from mvrecon.core.parts import NETWORKS, HeadPart, NetworkPart
from mvrecon.core.registry import check_choice
from mvrecon.methods.learned.cross_view import RESIDUAL_GAIN, PerViewEstimates
from mvrecon.methods.learned.geometry import geometry_of, validated
from mvrecon.methods.learned.start import (
    ClassicalStart,
    Consistency,
    Start,
    Steps,
    content_scale,
    nonzero,
    normalised,
    typical_chord,
)
from mvrecon.methods.learned.unet import PlainUNet, Precision, padded, trimmed
from mvrecon.methods.learned.view_frames import fuse
from mvrecon.methods.method import Reconstruction
from mvrecon.operators.operator import Projector
from mvrecon.operators.visual_hull.support import SUPPORT_KINDS, ViewNoise


class UNet3d(PlainUNet):
    """The U-Net of mvrecon's own models, as a network with a name.

    Args:
        inputs, outputs: channels.
        widths: channels of each scale, the finest first.
        precision: precision of the convolutions.
    """

    def __init__(
        self,
        inputs: int,
        outputs: int,
        widths: Sequence[int] = (16, 32, 64),
        precision: Precision = "float32",
    ):
        super().__init__(3, inputs, outputs, widths, precision=precision)


def network_by_name(config: NetworkPart, inputs: int, outputs: int, zero: int = 0) -> nn.Module:
    """Build a network by name, made to fit volumes of any size.

    Args:
        config: `{"name": ..., **options}`.
        inputs: channels in.
        outputs: channels out.
        zero: number of first outputs that start at exactly zero.

    Raises:
        LookupError: an unknown name.
        TypeError: a config without a name, an unknown option, or a part that is not a module.
    """
    network = NETWORKS.from_config(config, inputs, outputs)
    if not isinstance(network, nn.Module):
        raise TypeError(
            f"A network must be a torch.nn.Module, got {type(network).__name__} from {config}"
        )
    return SizedNetwork(network, outputs, zero)


class SizedNetwork(nn.Module):
    """A network adapted to a method: volumes of any size, and a start at zero.

    Volumes are padded with zeros at the end to sizes that the network supports, and its output is
    cropped. Every output has a learned factor, initially zero or one (ReZero, Bachlechner and
    others, UAI 2021).

    Args:
        network: maps volumes of some channels to volumes of others.
        outputs: channels out.
        zero: number of first outputs that start at exactly zero.

    Raises:
        ValueError: (call) the network's output is not a tensor of the input's size.
    """

    def __init__(self, network: nn.Module, outputs: int, zero: int = 0):
        super().__init__()
        self.network = network
        self.factor = nn.Parameter((torch.arange(outputs) >= zero).float().view(-1, 1, 1, 1))

    def forward(self, x: Float[Tensor, "n i d h w"]) -> Float[Tensor, "n o d h w"]:
        whole = padded(x, getattr(self.network, "multiple", 1))
        answer = self.network(whole)
        expected = (len(whole), len(self.factor), *whole.shape[2:])
        got = tuple(answer.shape) if isinstance(answer, Tensor) else type(answer).__name__
        if got != expected:
            raise ValueError(
                f"Expected the network {type(self.network).__name__} to keep the size of its "
                f"volumes and give a tensor {expected}, got {got}"
            )
        return self.factor * trimmed(answer, x.shape[2:])


class VolumeUNet(nn.Module):
    """A 3-D U-Net on a classical reconstruction, followed by data-consistency steps and
    non-negativity, in the unit of (views / mm).

    Args:
        widths: channels of each scale of the U-Net, the finest first.
        network: name and options of another network in its place.
        start: iterations of SIRT with momentum, or name and options of a classical method.
        consistency: number of data-consistency steps at the end, or options of `Consistency`.
        support: voxels that the views do not show to be empty: the visual "hull", its "box", "auto"
            or "none".
        noise: noise of the views, for the support, as in `support_from_views`.
        precision: precision of the convolutions.

    Raises:
        ValueError: an unknown support.
    """

    def __init__(
        self,
        widths: Sequence[int] = (16, 32, 64),
        network: NetworkPart | None = None,
        start: Start = 12,
        consistency: Steps = 3,
        support: str = "none",
        noise: ViewNoise | None = None,
        precision: Precision = "auto",
    ):
        super().__init__()
        check_choice("support", support, SUPPORT_KINDS)
        if network is None:
            self.network: nn.Module = PlainUNet(3, 3, 1, widths, zero=1, precision=precision)
        else:
            self.network = network_by_name(network, 3, 1, zero=1)
        self.step = nn.Parameter(torch.ones(()))
        self.consistency = Consistency(consistency)
        self.start = ClassicalStart(start)
        self.support, self.noise = support, noise

    def forward(self, views: Float[Tensor, "b 1 m v u"], A: Projector) -> Reconstruction:
        y = validated(views, A, self.step)
        g = geometry_of(y, A, self.support, self.noise)
        y, start, scale = normalised(g, y, self.start, self.training)
        d = g.direction(y - A(start))
        hull = torch.ones_like(start) if g.support is None else g.support.to(start)
        change = self.network(torch.cat([start, RESIDUAL_GAIN * d, hull], dim=1)) + self.step * d
        entry = start + g.within(change)
        x = self.consistency(g, entry, y).clamp_min(0)
        return Reconstruction(
            x * scale,
            support=g.support,
            start=start * scale,
            entry=entry * scale if self.consistency.em else None,
        )


class MeanFusion(nn.Module):
    """The mean over the cameras of their depth networks' estimates, at the grid's own resolution,
    then data-consistency steps and non-negativity, in the unit of (views / mm).

    Args:
        widths: channels of each scale of the depth network, the finest first.
        depths: bins along each ray.
        binning: pixels of a frustum's cell along each axis.
        head: name, or name and options, of the head.
        n_cameras: one network for each of so many cameras; None: one for all.
        start: iterations of SIRT with momentum, or name and options of a classical method.
        consistency: number of data-consistency steps at the end, or options of `Consistency`.
        precision: precision of the convolutions.
    """

    def __init__(
        self,
        widths: Sequence[int] = (8, 16),
        depths: int = 32,
        binning: int = 1,
        head: str | HeadPart = "softmax_depth",
        n_cameras: int | None = None,
        start: Start = 12,
        consistency: Steps = 3,
        precision: Precision = "auto",
    ):
        super().__init__()
        self.estimates = PerViewEstimates(
            widths, 0, 0, depths, binning, head, n_cameras=n_cameras, precision=precision
        )
        self.consistency = Consistency(consistency)
        self.start = ClassicalStart(start)

    def forward(self, views: Float[Tensor, "b 1 m v u"], A: Projector) -> Reconstruction:
        y = validated(views, A, self.consistency.lengths)
        g = geometry_of(y, A)
        frames = self.estimates.frames(g)
        y, x, scale = normalised(g, y, self.start, self.training)
        r = y - A(x)
        change, confidence, _, _ = self.estimates(frames, g, y, r, x)
        fused, weights = fuse(change, torch.zeros_like(confidence), frames.visible)
        entry = x + fused
        volume = self.consistency(g, entry, y).clamp_min(0)
        return Reconstruction(
            volume * scale,
            per_view=(x[:, None] + change) * scale[:, None],
            visible=frames.visible,
            weights=weights,
            start=x * scale,
            entry=entry * scale if self.consistency.em else None,
        )


class GeometryFree(nn.Module):
    """A 3-D U-Net on the views as channels, each repeated along the depth of the grid, in the unit
    of (views / mm). The operator gives only the grid and the scale of the views.

    Args:
        n_cameras: number of views.
        widths: channels of each scale of the U-Net, the finest first.
        network: name and options of another network in its place.
        precision: precision of the convolutions.
    """

    def __init__(
        self,
        n_cameras: int,
        widths: Sequence[int] = (16, 32, 64),
        network: NetworkPart | None = None,
        precision: Precision = "auto",
    ):
        super().__init__()
        self.n_cameras = n_cameras
        if network is None:
            self.network: nn.Module = PlainUNet(3, n_cameras, 1, widths, precision=precision)
        else:
            self.network = network_by_name(network, n_cameras, 1)

    def forward(self, views: Float[Tensor, "b 1 m v u"], A: Projector) -> Reconstruction:
        if len(A.cameras) != self.n_cameras:
            raise ValueError(f"Expected {self.n_cameras} cameras, got {len(A.cameras)}")
        views = validated(views, A, next(self.network.parameters())).contiguous()
        chord = typical_chord(A.grid)
        scale = content_scale(views) / chord
        depth, *across = A.grid.shape
        flat = F.interpolate((views / scale)[:, 0] / chord, size=across, mode="bilinear")
        volume = self.network(flat[:, :, None].expand(-1, -1, depth, -1, -1))
        return Reconstruction(volume * scale * nonzero(views))
