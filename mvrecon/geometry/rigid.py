"""Rigid motions X -> R X + t of the world: rotations from Euler angles, random rotations, inverses, look-at."""

import math
from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor


def euler_rotation(
    degrees: Sequence[float] | Sequence[Sequence[float]] | Float[Tensor, "*n 3"], axes: str = "zyz"
) -> Float[Tensor, "*n 3 3"]:
    """Rotation by three Euler angles in degrees, in float64.

    Convention: R = R_a(first) R_b(second) R_c(third) for axes "abc": intrinsic turns from left to right, equal to
    extrinsic turns from right to left. The default "zyz" is R_z(phi) R_y(theta) R_z(psi); each turn is right-handed.

    Raises:
        ValueError: not three angles, or axes that are not three of x, y, z.
    """
    from kornia.geometry.conversions import axis_angle_to_rotation_matrix  # slow to import

    angles = torch.as_tensor(degrees, dtype=torch.float64)
    if angles.ndim < 1 or angles.shape[-1] != 3:
        raise ValueError(f"Euler angles must be three degrees [.. 3], got shape {tuple(angles.shape)}")
    if len(axes) != 3 or not set(axes) <= set("xyz"):
        raise ValueError(f"Euler axes must be three letters of 'xyz', such as 'zyz', got {axes!r}")
    unit = torch.eye(3, dtype=torch.float64)[["xyz".index(a) for a in axes]]
    first, second, third = axis_angle_to_rotation_matrix(torch.deg2rad(angles)[..., None] * unit).unbind(-3)
    return first @ second @ third


def random_rotation(generator: torch.Generator, count: int | None = None) -> Float[Tensor, "*n 3 3"]:
    """Rotations uniform on SO(3) (Haar measure), in float64: one [3 3], or [count 3 3].

    A 4-D normal vector, made unit length, is a uniform quaternion (Shoemake, Graphics Gems III, 1992).
    """
    from kornia.geometry.conversions import quaternion_to_rotation_matrix  # slow to import

    shape = (4,) if count is None else (count, 4)
    return quaternion_to_rotation_matrix(torch.randn(shape, generator=generator, dtype=torch.float64))


def random_in_ball(generator: torch.Generator, radius: float = 1.0) -> Float[Tensor, "3"]:
    """A point uniform in the ball of a radius about the origin, in float64."""
    direction = torch.nn.functional.normalize(torch.randn(3, generator=generator, dtype=torch.float64), dim=0)
    return direction * radius * torch.rand((), generator=generator, dtype=torch.float64) ** (1 / 3)


def inverse(
    R: Float[Tensor, "*n 3 3"], t: Float[Tensor, "*n 3"]
) -> tuple[Float[Tensor, "*n 3 3"], Float[Tensor, "*n 3"]]:
    """The motion that undoes X -> R X + t: R^T and -R^T t."""
    return R.mT, -(R.mT @ t[..., None])[..., 0]


def look_at(
    source: Float[Tensor, "*n 3"],
    target: Float[Tensor, "*n 3"],
    up: Sequence[float] = (0.0, 0.0, 1.0),
) -> Float[Tensor, "*n 3 3"]:
    """World-to-camera rotation of a camera at `source` that looks at `target`, `up` being upwards in its image.

    Convention: as OpenCV, the rows are the camera's axes in the world: x to the right, y downwards, z forward. Where
    `up` is the line of sight itself, the world axis most across the line of sight takes its place.

    Raises:
        ValueError: the camera is at its target.
    """
    forward = target.to(torch.float64) - source.to(torch.float64)
    distance = forward.norm(dim=-1, keepdim=True)
    if not (distance > 0).all():
        raise ValueError(f"A camera must not be at the point it looks at, got {source.tolist()} and {target.tolist()}")
    forward = forward / distance
    vertical = torch.nn.functional.normalize(forward.new_tensor(up), dim=0).expand_as(forward)
    across = torch.eye(3).to(forward)[forward.abs().argmin(dim=-1)]
    along = torch.linalg.cross(forward, vertical).norm(dim=-1, keepdim=True) < math.sqrt(torch.finfo(forward.dtype).eps)
    right = torch.linalg.cross(forward, torch.where(along, across, vertical))
    right = torch.nn.functional.normalize(right, dim=-1)
    return torch.stack([right, torch.linalg.cross(forward, right), forward], dim=-2)
