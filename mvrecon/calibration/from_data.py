"""Calibration from the measured views alone: the misalignment that makes them consistent with one
volume.

A rig that is wrong leaves a residual that no volume explains. Rig and volume are fitted together by
Gauss-Newton steps on |S y - A(rig) G x|, with the views blurred by S and the volume made of
Gaussian blobs, G: with voxels alone a volume has so many freedoms that it explains a tilted axis,
too (of a sharp object wrongly by 0.4 degrees). In each step the rig's unknowns are eliminated
exactly and the volume's change comes from conjugate gradients (separable least squares: Golub &
Pereyra, SIAM J. Numer. Anal. 10, 1973; blobs: Lewitt, J. Opt. Soc. Am. A 7, 1990).
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from mvrecon.calibration.blur import Blur, blurred
from mvrecon.calibration.linearised import Complement, derivatives
from mvrecon.calibration.unknowns import Unknowns, unknowns
from mvrecon.cameras.camera import Cameras
from mvrecon.cameras.field import resolution
from mvrecon.cameras.misalignment import Misalignment, misaligned
from mvrecon.projectors.operator import LinearOperator, Projector, Scaled
from mvrecon.reconstruct.cgls import cgls

OperatorOf = Callable[[Cameras], Projector]

#: Standard deviation of a blob in voxels, and of the views' blur in voxels' images.
BLOB, VIEW_BLUR = 1.0, 2.0
#: The fit ends where no number changes by so much of its longest change.
CLOSE = 1e-3


class Round(NamedTuple):
    """A round of the fit, as a monitor sees it.

    Args:
        number: from 1.
        residual: |S y - A x| / |S y| of the blurred views at its start.
    """

    number: int
    residual: float


class Estimate(NamedTuple):
    """A calibrated rig.

    Args:
        cameras: the rig.
        misalignment: what was wrong with each view of the rig that was given, in pixels and
            degrees.
        gains: factor of each view's integrals, their geometric mean 1; to be divided by.
        residual: |S y - A x| / |S y| of the blurred views, at the start of each round and at the
            end; the first is that of the rig that was given.
    """

    cameras: Cameras
    misalignment: Misalignment
    gains: Float[Tensor, " m"]
    residual: list[float]


class _Model(NamedTuple):
    operator_of: OperatorOf
    cameras: Cameras
    unknowns: Unknowns

    def rig(self, values: Float[Tensor, "m k"]) -> Cameras:
        return misaligned(self.cameras, self.unknowns.misalignment(values))

    def operator(self, values: Float[Tensor, "m k"]) -> Projector:
        A = self.operator_of(self.rig(values))
        if "gain" not in self.unknowns.kinds:
            return A
        return Scaled(A, pixels=self.unknowns.gains(values)[:, None, None].to(A.device))


@torch.no_grad()
def calibrated(
    operator_of: OperatorOf,
    cameras: Cameras,
    views: Float[Tensor, "1 1 m v u"],
    free: Sequence[str] = ("offset_u", "tilt"),
    iterations: int = 15,
    rounds: int = 12,
    monitor: Callable[[Round], object] | None = None,
) -> Estimate:
    """Rig fitted in pixels and degrees to the measured views alone.

    Blobs and blur go with the grid's voxel: coarse voxels are fast and robust as long as the views
    are many for them (about three times as many as voxels across), and need not hold the object's
    edges. The object must be inside the grid and the views.

    Args:
        operator_of: the operator of a rig, such as `partial(Drr, grid)`.
        cameras: the rig as it should be.
        views: measured integrals.
        free: what is fitted. One number for all views: "offset_u", "offset_v" (pixels), "tilt"
            (about the beam, which is the tilt of the axis), "slant" (about u), "swivel" (about v;
            degrees). A number for each view: "shifts" (u and v, pixels), "gains" (factors). Along
            the axis of a circle an offset_v is nearly a shift of the object.
        iterations: of conjugate gradients in each round.
        rounds: of Gauss-Newton at most; it ends before where nothing changes any more.
        monitor: called after each round.

    Raises:
        ValueError: names that `unknowns` refuses; views that are not finite or of another shape
            than the operator's; parallel beams, which `misaligned` refuses.
    """
    model = _Model(operator_of, cameras, unknowns(cameras, free))
    values = model.unknowns.basis.new_zeros(model.unknowns.basis.shape[:2])
    A = model.operator(values)
    blobs = Blur(A.domain_shape, [BLOB] * 3, A.device)
    views = blurred(views, _view_blur(A))
    x = cgls(A @ blobs, views, iterations)
    history = []
    for number in range(1, rounds + 1):
        r = _residual(model, values, views, blobs(x))
        history.append((r.norm() / views.norm()).item())
        rig = Complement(
            derivatives(lambda v: model.operator(v)(blobs(x)), values),  # noqa: B023
            model.unknowns,
        )
        A = model.operator(values) @ blobs
        change = cgls(rig @ A, rig(r), iterations)
        x, step = x + change, rig.change(r - A(change))
        longest = model.unknowns.longest
        values = values + step.clamp(-longest, longest)
        if monitor is not None:
            monitor(Round(number, history[-1]))
        if (step.abs() < CLOSE * longest).all():
            break
    r = _residual(model, values, views, blobs(x))
    history.append((r.norm() / views.norm()).item())
    by, gains = model.unknowns.misalignment(values), model.unknowns.gains(values)
    return Estimate(model.rig(values), by, gains, history)


def _residual(model: _Model, values: Tensor, views: Tensor, volume: Tensor) -> Tensor:
    return views - model.operator(values)(volume)


def _view_blur(A: Projector) -> float:
    """Blur of the views in pixels."""
    centre = A.grid.corners().mean(dim=0)
    pixel = resolution(A.cameras.to("cpu"), centre.to("cpu").double())
    return VIEW_BLUR * max(A.grid.spacing) / pixel
