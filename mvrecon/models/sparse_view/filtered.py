"""Filtered back-projection inside of networks: of a rig, and of views that are scaled alike."""

from collections.abc import Mapping
from typing import Any, NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor, nn

from mvrecon.cameras.camera import Cameras
from mvrecon.geometry.grid import Grid
from mvrecon.models.network import network_by_name
from mvrecon.models.start import anything, content_scale
from mvrecon.projectors.operator import Projector
from mvrecon.reconstructors.filtered.fdk import fbp, fdk
from mvrecon.reconstructors.filtered.filters import Filter

#: The network of a model that is given none.
NETWORK = {"name": "unet2d"}


class Geometry(NamedTuple):
    """Where voxels and rays are; all that filtered back-projection knows of an operator."""

    grid: Grid
    cameras: Cameras


class Scaled(NamedTuple):
    """Views and their filtered back-projection, both divided by the content's scale.

    Args:
        views: in mm, as of an object of values about one.
        volume: values about one.
        scale: what both were divided by, in the unit of the volume; zero for views of nothing.
    """

    views: Float[Tensor, "b 1 m v u"]
    volume: Float[Tensor, "b 1 d h w"]
    scale: Float[Tensor, "b 1 1 1 1"]


def filtered(
    A: Projector | Geometry, views: Float[Tensor, "b c m v u"], filter: Filter
) -> Float[Tensor, "b c d h w"]:
    """Filtered back-projection of parallel beams and fans, or FDK of cones, in (unit of the views)
    / mm.
    """
    flat = A.cameras.parallel or A.cameras.shape[0] == 1
    return (fbp if flat else fdk)(A, views, filter)  # pyright: ignore[reportArgumentType]


def scaled(A: Projector, views: Float[Tensor, "b 1 m v u"], filter: Filter) -> Scaled:
    """Views and their filtered back-projection, divided by a scale that is not differentiated:
    f(a y) = a f(y) of whatever follows.
    """
    volume = filtered(A, views, filter)
    scale = content_scale(volume.detach())
    return Scaled(views / scale, volume / scale, scale * anything(views))


def in_full_precision(views: Tensor) -> torch.autocast:
    """Context without autocast: the ramp amplifies what half precision rounds in a sinogram."""
    return torch.autocast(views.device.type, enabled=False)


def corrector(
    config: Mapping[str, Any] | None, inputs: int, outputs: int = 1, zero: int | None = None
) -> nn.Module:
    """A network by name, a 2-D U-Net by default, whose outputs start at exactly zero."""
    return network_by_name(config or NETWORK, inputs, outputs, 0, outputs if zero is None else zero)


def sinograms(views: Float[Tensor, "b c m v u"]) -> Float[Tensor, "b c v m u"]:
    """A sinogram for each row of the detector, and back: networks take them for slices."""
    return views.transpose(2, 3)
