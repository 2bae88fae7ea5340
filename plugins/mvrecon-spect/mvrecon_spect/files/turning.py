"""Angles of a rig's detectors about the z axis, compared with those that a file states."""

import torch
from jaxtyping import Float
from torch import Tensor

from mvrecon.geometry.cameras.camera import Cameras

#: Degrees by which the angle of a camera may differ from that of its view, for rounding.
MAX_ANGLE = 1.0


def turned(cameras: Cameras) -> Float[Tensor, " m"]:
    """Angle in degrees, 0 to 360, by which the detector of each camera is turned from the first.

    Convention: with z towards the head, angles increase from the patient's back (-y) to the left
    (-x), as in DICOM.
    """
    normal = torch.linalg.cross(cameras.u, cameras.v)
    normal = normal * ((cameras.origin - cameras.source) * normal).sum(-1, keepdim=True).sign()
    angles = torch.rad2deg(torch.atan2(-normal[:, 0], -normal[:, 1]))
    return (angles - angles[0]) % 360


def apart(first: Tensor, second: Tensor) -> Tensor:
    """Difference of angles in degrees, 0 to 180."""
    return ((first - second + 180) % 360 - 180).abs()
