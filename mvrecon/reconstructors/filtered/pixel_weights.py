"""What a view is multiplied by before it is filtered: cosine weight, share of each ray, angle, and
pixel pitch.

On a flat detector at the distance D from the source, with rows t along the unit vector U, FBP of a
fan beam reads

    f(x) = sum over views  dbeta (D / z)^2  sum over t  share(beta, t) W(t) g(t) h(t' - t) dt

with z the depth of x along the detector's normal, h the ramp, q the vector from the source to the
pixel, R T = dS/dbeta the source's motion, and

    W = R (T.U q.q - U.q T.q) / (|q| (q.q - (U.q)^2)),

the part of the motion across the ray in the plane of the row, over the distance from the source to
the row. This holds for every flat detector, however it is turned in the fan's plane: the ramp's
degree, h(c t) = h(t) / c^2, takes the turn up. A detector across the central ray has W = R / |q| =
(R / D) cos: the cosine weight of Feldkamp, Davis and Kress, JOSA A 1, 1984, eq. 28, whose other
factor (R / D) belongs to its virtual detector at the axis. Rows of a cone beam are taken for fans
in their tilted planes, as theirs are. For parallel rays W = 1 / T.U.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from mvrecon.cameras.camera import Cameras
from mvrecon.geometry.rigid import unit
from mvrecon.reconstructors.filtered.scan_weights import (
    Scan,
    along,
    fan_coordinate,
    redundancy,
)


def pixel_weights(
    rig: Cameras, scan: Scan, dtype: torch.dtype = torch.float32
) -> Float[Tensor, "m v u"]:
    """The weights of views' pixels, without unit: radian per pixel times mm per mm.

    Args:
        rig: the views' cameras.
        scan: of these views, on the cameras' device.
        dtype: of the arithmetic over pixels; geometry is float64.
    """
    orbit, device = scan.orbit, rig.source.device
    v, u = (torch.arange(n, dtype=dtype, device=device) for n in rig.shape)
    tangents, rows, pitch = orbit.tangents, unit(rig.u), rig.u.norm(dim=-1)
    slant = (tangents * rows).sum(dim=-1)
    angle = (scan.steps / pitch).to(dtype)[:, None, None]
    fan = _fan(rig, scan, u, v)
    share = redundancy(scan, fan) * angle
    if rig.parallel:
        return share / slant.abs().to(dtype)[:, None, None]
    start = rig.origin - rig.source
    by_row, by_motion = along(start, rig, rows, u, v), along(start, rig, tangents, u, v)
    square = _squares(rig, u, v)
    motion = slant.to(dtype)[:, None, None] * square - by_row * by_motion
    return share * orbit.radius * motion.abs() * square.rsqrt() / (square - by_row.square())


def _fan(
    rig: Cameras, scan: Scan, u: Float[Tensor, " u"], v: Float[Tensor, " v"]
) -> Float[Tensor, "m v u"]:
    """Fan coordinates; of one pixel a view where the shares do not depend on them."""
    if scan.kind == "full":
        return u.new_zeros(len(rig), 1, 1)
    return fan_coordinate(rig, scan.orbit, u, v)


def _squares(
    rig: Cameras, u: Float[Tensor, " u"], v: Float[Tensor, " v"]
) -> Float[Tensor, "m v u"]:
    """Squared distances of pixels from the source in mm^2."""
    axis_u, axis_v = unit(rig.u), unit(rig.v)
    normal = unit(torch.linalg.cross(axis_u, axis_v))
    start = rig.origin - rig.source
    level = torch.linalg.cross(normal, axis_u)
    parts = (along(start, rig, axis, u, v).square() for axis in (axis_u, level))
    depth = (start * normal).sum(dim=-1).square().to(u)[:, None, None]
    return sum(parts, start=depth)
