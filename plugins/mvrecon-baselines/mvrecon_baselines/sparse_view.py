"""Three approaches to sparse-view reconstruction with networks and filtered back-projection:
projection domain, image domain, and both.

X. Liang, Y. Yang, L. Xing, "Comparison of projection domain, image domain, and comprehensive deep
learning for sparse-view X-ray CT image reconstruction", arXiv 1804.04289 (2018).

All methods divide views and volume by the scale of the filtered back-projection, f(a y) = a f(y),
and all networks initially return zero: before training, the volume is the filtered back-projection.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import get_args

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn
from torch.nn.functional import pad

from mvrecon.core.registry import check_choice
from mvrecon.methods.classical.fdk import Filter, fbp, fdk
from mvrecon.methods.classical.orbit import orbit_of
from mvrecon.methods.learned.geometry import validated
from mvrecon.methods.learned.start import content_scale, nonzero, typical_chord
from mvrecon.methods.method import Reconstruction
from mvrecon.operators.memo import kept
from mvrecon.operators.operator import Projector
from mvrecon.operators.ray_transform import RayTransform
from mvrecon_baselines.unet2d import UNet2d

#: A scan is a full circle if its largest gap is at most this many median steps.
WHOLE = 1.5
#: Share of lines without rays that a network may complete, as those behind the last of few views.
MISSING = 0.25
#: Number of views by which the sinogram of a full circle is padded periodically at both ends.
WRAP = 8


class FbpUNet(nn.Module):
    """Image domain: filtered back-projection, followed by a network that removes streaks, in (unit
    of the views) / mm.

    FBP for slices of fans and parallel beams, FDK for cone beams (Jin and others, IEEE Trans. Image
    Process. 26, 2017).

    Args:
        width, levels: width and levels of the network on slices, see `UNet2d`.
        filter: window of the ramp, as in `fbp`.

    Raises:
        ValueError: an unknown filter.
    """

    def __init__(self, width: int = 32, levels: int = 4, filter: Filter = "ram-lak"):
        super().__init__()
        self.image_net = UNet2d(1, 1, width, levels, zero=1)
        check_choice("filter", filter, get_args(Filter))
        self.filter: Filter = filter

    def forward(self, views: Float[Tensor, "b 1 m v u"], A: Projector) -> Reconstruction:
        y = validated(views, A, self.image_net.last.weight)
        with full_precision(y):
            _, start, scale = scaled(A, y, self.filter)
            volume = start + self.image_net(start)
        return Reconstruction(volume * scale, start=start * scale)


@dataclass(kw_only=True)
class CompletedViews(Reconstruction):
    """A filtered back-projection of views completed by a network.

    Args:
        completed: the views at all angles, including the measured ones.
        dense: the operator of all angles.
    """

    completed: Float[Tensor, "b 1 n v u"]
    dense: Projector


def completed_views(
    out: Reconstruction, batch: Mapping[str, Tensor], data_range: float
) -> Float[Tensor, ""]:
    """Loss term: mean squared error of the completed views, as mean densities along a chord of the
    grid's edge length, relative to the data range, without a unit; zero for other methods.
    """
    if not isinstance(out, CompletedViews):
        return out.volume.new_zeros(())
    error = out.completed - out.dense(batch["volume"])
    return (error / (typical_chord(out.dense.grid) * data_range)).square().mean()


class SinogramUNet(nn.Module):
    """Projection domain: views interpolated in angle, corrected by a network on the sinograms, then
    filtered back-projection, in (unit of the views) / mm.

    The second input channel of the network marks measured views with one. Training is end to end
    through the back-projection; the loss term `completed_views` adds the error of the completed
    views, and is the only term with `volume: 0`, as published.

    Args:
        factor: number of views per measured view.
        width, levels: width and levels of the network, see `UNet2d`.
        filter: window of the ramp, as in `fbp`.

    Raises:
        ValueError: a factor below one, or an unknown filter.
    """

    def __init__(
        self, factor: int = 4, width: int = 32, levels: int = 4, filter: Filter = "ram-lak"
    ):
        super().__init__()
        if factor < 1:
            raise ValueError(f"Expected a factor of at least 1 for views, got {factor}")
        self.sinogram_net: nn.Module = UNet2d(2, 1, width, levels, zero=1)
        self.image_net: nn.Module | None = None
        self.factor = factor
        check_choice("filter", filter, get_args(Filter))
        self.filter: Filter = filter

    def forward(self, views: Float[Tensor, "b 1 m v u"], A: Projector) -> Reconstruction:
        y = validated(views, A, next(self.parameters()))
        with full_precision(y):
            y, start, scale = scaled(A, y, self.filter)
            angles = kept(A, ("angles", self.factor), lambda: Upsampling.of(A, self.factor))
            completed = self.completed(angles, y)
            volume = filtered(angles.dense, completed, self.filter)
            if self.image_net is not None:
                volume = volume + self.image_net(volume)
        return CompletedViews(
            volume * scale, start=start * scale, completed=completed * scale, dense=angles.dense
        )

    def completed(
        self, angles: "Upsampling", views: Float[Tensor, "b 1 m v u"]
    ) -> Float[Tensor, "b 1 n v u"]:
        """The views of all angles from the measured ones."""
        views = angles(views)
        chord, count = typical_chord(angles.dense.grid), views.shape[2]
        measured = torch.arange(count, device=views.device) % self.factor == 0
        rows = sinograms(views) / chord
        inputs = torch.cat([rows, measured[:, None].to(rows).expand_as(rows)], dim=1)
        wrap = min(WRAP, count) if angles.closed else 0
        inputs = pad(inputs, (0, 0, wrap, wrap, 0, 0), mode="circular")
        change = self.sinogram_net(inputs)[..., wrap : wrap + count, :]
        return views + chord * sinograms(change)


class DualDomain(SinogramUNet):
    """Both domains, end to end: sinogram network, filtered back-projection, image network, in (unit
    of the views) / mm.

    Args:
        factor: number of views per measured view.
        width, levels: width and levels of each network, see `UNet2d`.
        filter: window of the ramp, as in `fbp`.

    Raises:
        ValueError: a factor below one, or an unknown filter.
    """

    def __init__(
        self, factor: int = 4, width: int = 32, levels: int = 4, filter: Filter = "ram-lak"
    ):
        super().__init__(factor, width, levels, filter)
        self.image_net = UNet2d(1, 1, width, levels, zero=1)


@dataclass(frozen=True, eq=False)
class Upsampling:
    """Upsampling in angle: factor - 1 views between adjacent views on a circle.

    Args:
        order: indices of the measured views, sorted by angle.
        factor: number of views per measured view.
        closed: whether the first view follows the last one, as in a full circle.
        dense: the operator of all views, sorted by angle.
    """

    order: Int[Tensor, " m"]
    factor: int
    closed: bool
    dense: RayTransform

    @classmethod
    def of(cls, A: Projector, factor: int) -> "Upsampling":
        """Upsampling of an operator's views: each new camera is its predecessor, rotated about the
        axis.

        Raises:
            ValueError: sources that are not on a circle.
        """
        orbit = orbit_of(A.cameras, A.grid)
        angles, order = orbit.angles.remainder(360).sort()
        gaps = torch.cat([angles, angles[:1] + 360]).diff()
        closed = bool(gaps.max() <= WHOLE * gaps.median())
        if not closed:  # the scan begins after its largest gap
            first = int(gaps.argmax()) + 1
            order, gaps = order.roll(-first), gaps.roll(-first)
        count = len(order) * factor - (0 if closed else factor - 1)
        turns = (gaps[:, None] * torch.arange(factor).to(gaps) / factor).flatten()[:count]
        before = order.repeat_interleave(factor)[:count]
        dense = RayTransform(A.grid, orbit.turned(A.cameras[before], turns)).to(A.device)
        return cls(order.to(A.device), factor, closed, dense)

    def __call__(self, views: Float[Tensor, "b c m v u"]) -> Float[Tensor, "b c n v u"]:
        """Views at all angles, linear between measured views, which do not change."""
        views = views.index_select(2, self.order)
        after = views.roll(-1, dims=2)
        steps = [torch.lerp(views, after, k / self.factor) for k in range(self.factor)]
        return torch.stack(steps, dim=3).flatten(2, 3)[:, :, : self.dense.range_shape[0]]


def filtered(
    A: Projector, views: Float[Tensor, "b c m v u"], filter: Filter
) -> Float[Tensor, "b c d h w"]:
    """FBP of parallel beams and fans, or FDK of cones, in (unit of the views) / mm."""
    flat = A.cameras.parallel or A.cameras.shape[0] == 1
    return (fbp if flat else fdk)(A, views, filter, max_missing=MISSING)


def scaled(
    A: Projector, views: Float[Tensor, "b 1 m v u"], filter: Filter
) -> tuple[Float[Tensor, "b 1 m v u"], Float[Tensor, "b 1 d h w"], Float[Tensor, "b 1 1 1 1"]]:
    """Views and their filtered back-projection, both divided by the scale of the content, and that
    scale (zero for zero views).
    """
    volume = filtered(A, views, filter)
    scale = content_scale(volume)
    return views / scale, volume / scale, scale * nonzero(views)


def full_precision(views: Tensor) -> torch.autocast:
    """Context without autocast: the ramp amplifies the rounding of half precision."""
    return torch.autocast(views.device.type, enabled=False)


def sinograms(views: Float[Tensor, "b c m v u"]) -> Float[Tensor, "b c v m u"]:
    """A sinogram for each detector row, as slices for a network; its own inverse."""
    return views.transpose(2, 3)
