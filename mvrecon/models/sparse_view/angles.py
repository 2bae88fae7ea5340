"""Views between the measured ones: a rig with more angles, and sinograms interpolated to it."""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from mvrecon.cameras.camera import Cameras
from mvrecon.geometry.grid import Grid
from mvrecon.geometry.rigid import unit
from mvrecon.kernels.device_cache import device_cached
from mvrecon.reconstructors.filtered.orbit import Orbit, orbit_of

#: A scan is a whole turn if its largest gap is at most so many median steps.
WHOLE = 1.5


@dataclass(frozen=True, eq=False)
class AngularUpsampling:
    """Upsampling in angle adds factor - 1 views between neighbours on a circle, in the views' unit.

    Args:
        order: of the measured views, by their angles.
        factor: views for one measured view.
        closed: whether the last view's neighbour is the first, in a scan of a whole turn.
        cameras: the rig of all views, by their angles.
    """

    order: Int[Tensor, " m"]
    factor: int
    closed: bool
    cameras: Cameras

    @classmethod
    def of(cls, cameras: Cameras, grid: Grid, factor: int) -> "AngularUpsampling":
        """Upsampling of a rig's views: each new camera is its predecessor, turned about the axis.

        Raises:
            ValueError: a factor below one, or sources that are not on a circle.
        """
        if factor < 1:
            raise ValueError(f"Expected a factor of at least 1 for views, got {factor}")
        orbit = orbit_of(cameras, grid)
        angles, order = orbit.angles.remainder(360).sort()
        gaps = torch.cat([angles, angles[:1] + 360]).diff()
        closed = bool(gaps.max() <= WHOLE * gaps.median())
        if not closed:  # the scan begins behind its largest gap
            first = int(gaps.argmax()) + 1
            order, gaps = order.roll(-first), gaps.roll(-first)
        count = len(order) * factor - (0 if closed else factor - 1)
        steps = torch.arange(factor).to(gaps) / factor
        turns = (gaps[:, None] * steps).flatten()[:count]
        before = order.repeat_interleave(factor)[:count]
        return cls(order, factor, closed, turned(cameras[before], orbit, turns))

    def __call__(self, views: Float[Tensor, "b c m v u"]) -> Float[Tensor, "b c n v u"]:
        """Views of all angles, linear between measured neighbours; measured ones stay as they
        are.
        """
        order = device_cached(self.cameras, "order", views, lambda: self.order.to(views.device))
        views = views.index_select(2, order)
        if self.factor == 1:
            return views
        after = views.roll(-1, dims=2)
        steps = [torch.lerp(views, after, k / self.factor) for k in range(self.factor)]
        return torch.stack(steps, dim=3).flatten(2, 3)[:, :, : len(self.cameras)]


def turned(cameras: Cameras, orbit: Orbit, degrees: Float[Tensor, " m"]) -> Cameras:
    """Cameras, each turned about an orbit's axis by its own angle in degrees."""
    R = rotations(orbit.axis, degrees)

    def rotated(vector: Float[Tensor, "m 3"]) -> Float[Tensor, "m 3"]:
        return torch.einsum("mij,mj->mi", R, vector.to(R))

    source, origin = (
        orbit.centre + rotated(point - orbit.centre) for point in (cameras.source, cameras.origin)
    )
    u, v = rotated(cameras.u), rotated(cameras.v)
    return replace(cameras, source=source, origin=origin, u=u, v=v)


def rotations(axis: Float[Tensor, "3"], degrees: Float[Tensor, " m"]) -> Float[Tensor, "m 3 3"]:
    """Rotations about an axis, right-handed, in float64 (Rodrigues' formula)."""
    x, y, z = unit(axis).tolist()
    cross = axis.new_tensor([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    angles = torch.deg2rad(degrees.to(axis))[:, None, None]
    return torch.eye(3).to(axis) + angles.sin() * cross + (1 - angles.cos()) * (cross @ cross)
