"""World axes in which a geometry file's coordinates are given: RAS, LPS, and IEC 61217."""

from typing import Literal, get_args

import torch
from jaxtyping import Float
from torch import Tensor

from mvrecon.core.registry import hint
from mvrecon.geometry.cameras.camera import Cameras

World = Literal["RAS", "LPS", "IEC"]

_TO_RAS = {
    "RAS": [[1, 0, 0], [0, 1, 0], [0, 0, 1]],
    "LPS": [[-1, 0, 0], [0, -1, 0], [0, 0, 1]],
    "IEC": [[-1, 0, 0], [0, 0, 1], [0, 1, 0]],
}


def to_ras(world: str) -> Float[Tensor, "3 3"]:
    """Rotation from the axes of a geometry file to RAS, mvrecon's world, in mm.

    Args:
        world: "RAS" (+x right, +y anterior, +z superior; NIfTI), "LPS" (+x left, +y posterior, +z
            superior; DICOM, ITK), or "IEC" (+x to the right of who faces the gantry, +y to the
            gantry, +z upwards).

    Convention: IEC 61217's fixed axes with the patient on his back, head first: x is the patient's
    left, y superior, z anterior.

    Raises:
        ValueError: another name.
    """
    if world not in _TO_RAS:
        raise ValueError(f"Unknown world {world!r}{hint(str(world), get_args(World))}")
    return torch.tensor(_TO_RAS[world], dtype=torch.float64)


def from_world(cameras: Cameras, world: str) -> Cameras:
    """Cameras in RAS mm from cameras in a file's axes; see `to_ras`."""
    return cameras.moved(to_ras(world), torch.zeros(3))


def into_world(cameras: Cameras, world: str) -> Cameras:
    """Cameras in a file's axes from cameras in RAS mm; the inverse of `from_world`."""
    return cameras.moved(to_ras(world).T, torch.zeros(3))
