"""Rigid motions X -> R X + t of the world: Euler angles, random rotations, inverses, look-at."""

import math
from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor


def euler_rotation(
    degrees: Sequence[float] | Sequence[Sequence[float]] | Float[Tensor, "*n 3"], axes: str = "zyz"
) -> Float[Tensor, "*n 3 3"]:
    """Rotation by three Euler angles in degrees, in float64.

    Convention: R = R_a(first) R_b(second) R_c(third) for axes "abc": intrinsic rotations from left
    to right, equal to extrinsic ones from right to left. The default "zyz" is R_z(phi) R_y(theta)
    R_z(psi); each rotation is right-handed.

    Raises:
        ValueError: not three angles, or axes that are not three of x, y, z.
    """
    from kornia.geometry.conversions import axis_angle_to_rotation_matrix  # slow to import

    angles = torch.as_tensor(degrees, dtype=torch.float64)
    if angles.ndim < 1 or angles.shape[-1] != 3:
        raise ValueError(
            f"Euler angles must be three degrees [.. 3], got shape {tuple(angles.shape)}"
        )
    if len(axes) != 3 or not set(axes) <= set("xyz"):
        raise ValueError(f"Euler axes must be three letters of 'xyz', such as 'zyz', got {axes!r}")
    unit = torch.eye(3, dtype=torch.float64)[["xyz".index(a) for a in axes]]
    turns = axis_angle_to_rotation_matrix(torch.deg2rad(angles)[..., None] * unit)
    first, second, third = turns.unbind(-3)
    return first @ second @ third


def euler_degrees(R: Float[Tensor, "*n 3 3"]) -> Float[Tensor, "*n 3"]:
    """Euler angles (phi, theta, psi) of rotations in degrees, with R = R_z(phi) R_y(theta)
    R_z(psi), in float64.

    Convention: theta in [0, 180], phi and psi in (-180, 180]; if theta is 0 or 180, psi is 0.

    Raises:
        ValueError: matrices that are not rotations.
    """
    check_rotation(R)
    R = R.to(torch.float64)
    sine = torch.hypot(R[..., 0, 2], R[..., 1, 2])
    flat = sine < 1e-9
    phi = torch.where(
        flat,
        torch.atan2(R[..., 2, 2].sign() * R[..., 1, 0], R[..., 1, 1]),
        torch.atan2(R[..., 1, 2], R[..., 0, 2]),
    )
    psi = torch.where(flat, 0.0, torch.atan2(R[..., 2, 1], -R[..., 2, 0]))
    return torch.rad2deg(torch.stack([phi, torch.atan2(sine, R[..., 2, 2]), psi], dim=-1))


def random_rotation(
    generator: torch.Generator, count: int | None = None
) -> Float[Tensor, "*n 3 3"]:
    """Rotations uniform on SO(3) (Haar measure), in float64: one [3 3], or [count 3 3].

    A normalised 4-D normal vector is a uniform quaternion (Shoemake, Graphics Gems III, 1992).
    """
    from kornia.geometry.conversions import quaternion_to_rotation_matrix  # slow to import

    shape = (4,) if count is None else (count, 4)
    return quaternion_to_rotation_matrix(
        torch.randn(shape, generator=generator, dtype=torch.float64)
    )


def random_in_ball(generator: torch.Generator, radius: float = 1.0) -> Float[Tensor, "3"]:
    """A point uniform in the ball of a radius about the origin, in float64."""
    direction = torch.nn.functional.normalize(
        torch.randn(3, generator=generator, dtype=torch.float64), dim=0
    )
    return direction * radius * torch.rand((), generator=generator, dtype=torch.float64) ** (1 / 3)


def rotation_by(vectors: Float[Tensor, "m 3"]) -> Float[Tensor, "m 3 3"]:
    """Rotations by rotation vectors in radians, smooth at zero."""
    x, y, z = vectors.unbind(dim=-1)
    zero = torch.zeros_like(x)
    rows = [torch.stack(row, dim=-1) for row in ((zero, -z, y), (z, zero, -x), (-y, x, zero))]
    return torch.linalg.matrix_exp(torch.stack(rows, dim=-2))


def inverse(
    R: Float[Tensor, "*n 3 3"], t: Float[Tensor, "*n 3"]
) -> tuple[Float[Tensor, "*n 3 3"], Float[Tensor, "*n 3"]]:
    """The inverse of the motion X -> R X + t: R^T and -R^T t."""
    return R.mT, -(R.mT @ t[..., None])[..., 0]


def unit(vectors: Float[Tensor, "*n"], dim: int = -1) -> Float[Tensor, "*n"]:
    """Normalise vectors, also those below 1e-12, which torch does not; zero stays zero."""
    return torch.nn.functional.normalize(vectors, dim=dim, eps=torch.finfo(vectors.dtype).tiny)


def check_rotation(R: Float[Tensor, "*n 3 3"]) -> None:
    """Raise if matrices are not rotations.

    Raises:
        ValueError: R R^T deviates by more than 1e-5 from 1 (above float32 rounding), or det R is
            not +1.
    """
    off = (R.detach() @ R.detach().mT - torch.eye(3).to(R)).abs().amax()
    if not (off < 1e-5 and (torch.linalg.det(R.detach()) > 0).all()):
        what = "one is left-handed" if off < 1e-5 else f"R R^T is off by {off:.2g}"
        raise ValueError(
            f"R must be rotations, with R R^T = 1 and det R = +1, but {what}, got {R.tolist()}"
        )


def look_at(
    source: Float[Tensor, "*n 3"],
    target: Float[Tensor, "*n 3"],
    up: Sequence[float] = (0.0, 0.0, 1.0),
) -> Float[Tensor, "*n 3 3"]:
    """World-to-camera rotation of a camera at `source` that looks at `target`, with `up` upwards in
    its image.

    Convention: as OpenCV, the rows are the camera's axes in the world: x to the right, y downwards,
    z forward. If `up` is parallel to the line of sight, the world axis most perpendicular to that
    replaces it.

    Raises:
        ValueError: the camera is at its target, or one of the three is not finite.
    """
    forward = target.to(torch.float64) - source.to(torch.float64)
    distance = forward.norm(dim=-1, keepdim=True)
    if not ((distance > 0) & distance.isfinite()).all():
        raise ValueError(
            "A camera must not be at the point it looks at, and both must be finite, "
            f"got {source.tolist()} and {target.tolist()}"
        )
    forward = forward / distance
    vertical = unit(forward.new_tensor(up)).expand_as(forward)
    if not vertical.isfinite().all():
        raise ValueError(f"A camera's up must be finite, got {up}")
    # of equal ones the first, whatever rounding makes of zeros
    across = torch.eye(3).to(forward)[forward.abs().round(decimals=6).argmin(dim=-1)]
    along = torch.linalg.cross(forward, vertical).norm(dim=-1, keepdim=True) < math.sqrt(
        torch.finfo(forward.dtype).eps
    )
    right = torch.linalg.cross(forward, torch.where(along, across, vertical))
    # near the line of sight `up` leaves `right` imprecise: make it orthogonal to the other two
    down = unit(torch.linalg.cross(forward, unit(right)))
    return torch.stack([torch.linalg.cross(down, forward), down, forward], dim=-2)
