"""Angles of a rig's detectors about an axis, compared with those that a file states."""

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from mvrecon.geometry.cameras.camera import Cameras

#: Degrees by which the angle of a camera may differ from that of its view, for rounding.
MAX_ANGLE = 1.0


def turned(cameras: Cameras, axis: Float[Tensor, " 3"]) -> Float[Tensor, " m"]:
    """Angle in degrees, 0 to 360, by which the detector of each camera is turned from the first,
    counter-clockwise seen from the tip of the axis.
    """
    normal = torch.linalg.cross(cameras.u, cameras.v)
    normal = normal * ((cameras.origin - cameras.source) * normal).sum(-1, keepdim=True).sign()
    first = normal[0] - normal[0] @ axis * axis / axis.square().sum()
    ahead = torch.linalg.cross(F.normalize(axis, dim=0), first)
    return torch.rad2deg(torch.atan2(normal @ ahead, normal @ first)) % 360


def apart(first: Tensor, second: Tensor) -> Tensor:
    """Difference of angles in degrees, 0 to 180."""
    return ((first - second + 180) % 360 - 180).abs()
