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
from mvrecon.cameras.views import check_finite
from mvrecon.projectors.operator import LinearOperator, Projector, Scaled
from mvrecon.reconstructors.cgls import cgls

OperatorOf = Callable[[Cameras], Projector]

#: Standard deviation of a blob in voxels, and of the views' blur in voxels' images.
BLOB, VIEW_BLUR = 1.0, 2.0
#: The fit ends where no number changes by so much of its longest change.
CLOSE = 2e-3


class Round(NamedTuple):
    """A round of the fit, as a monitor sees it.

    Args:
        number: from 1.
        residual: |S y - A x| / |S y| of the blurred views at its end.
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
        residual: |S y - A x| / |S y| of the blurred views, of the rig that was given and after
            each round.
    """

    cameras: Cameras
    misalignment: Misalignment
    gains: Float[Tensor, " m"]
    residual: list[float]


class _Problem(NamedTuple):
    """Blurred views, and what explains them: a volume of blobs, and the rig's unknowns."""

    operator_of: OperatorOf
    cameras: Cameras
    unknowns: Unknowns
    blobs: Blur
    views: Float[Tensor, "1 1 m v u"]

    def rig(self, values: Float[Tensor, "m k"]) -> Cameras:
        return misaligned(self.cameras, self.unknowns.misalignment(values))

    def operator(self, values: Float[Tensor, "m k"]) -> LinearOperator:
        """From a volume's coefficients to its views."""
        A = self.operator_of(self.rig(values))
        if "gain" in self.unknowns.kinds:
            A = Scaled(A, pixels=self.unknowns.gains(values)[:, None, None].to(A.device))
        return A @ self.blobs

    def residual(self, values: Float[Tensor, "m k"], x: Float[Tensor, "1 1 d h w"]) -> Tensor:
        return self.views - self.operator(values)(x)

    def relative(self, values: Float[Tensor, "m k"], x: Float[Tensor, "1 1 d h w"]) -> float:
        return (self.residual(values, x).norm() / self.views.norm()).item()


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
    """Rig fitted to the measured views alone, in pixels and degrees.

    Blobs and blur go with the grid's voxel. Voxels may be coarse, which is fast and robust: edges
    need not be resolved, but there should be about as many views as voxels across. The object must
    be inside the grid and inside all views.

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
        ValueError: names that `unknowns` refuses; views that are zero, not finite, or of another
            shape than the operator's; parallel beams, which `misaligned` refuses.
    """
    numbers = unknowns(cameras, free)
    values = numbers.basis.new_zeros(numbers.basis.shape[:2])
    A = operator_of(misaligned(cameras, numbers.misalignment(values)))
    _check(views, A)
    blobs = Blur(A.domain_shape, [BLOB] * 3, A.device)
    problem = _Problem(operator_of, cameras, numbers, blobs, blurred(views, _view_blur(A)))
    x = cgls(problem.operator(values), problem.views, iterations)
    history = [problem.relative(values, x)]
    for number in range(1, rounds + 1):
        last = values
        values, x = _improved(problem, values, x, iterations)
        history.append(problem.relative(values, x))
        if monitor is not None:
            monitor(Round(number, history[-1]))
        if ((values - last).abs() < CLOSE * numbers.longest).all():
            break
    by = numbers.misalignment(values)
    return Estimate(problem.rig(values), by, numbers.gains(values), history)


def _improved(
    problem: _Problem, values: Float[Tensor, "m k"], x: Float[Tensor, "1 1 d h w"], iterations: int
) -> tuple[Float[Tensor, "m k"], Float[Tensor, "1 1 d h w"]]:
    """The rig's numbers and the volume after a Gauss-Newton step for both."""
    A, r = problem.operator(values), problem.residual(values, x)
    columns = derivatives(lambda moved: problem.operator(moved)(x), values)
    rest = Complement(columns, problem.unknowns)
    change = cgls(rest @ A, rest(r), iterations)
    longest = problem.unknowns.longest
    step = rest.change(r - A(change)).clamp(-longest, longest)
    return values + step, x + change


def _check(views: Float[Tensor, "1 1 m v u"], A: Projector) -> None:
    if tuple(views.shape) != (1, 1, *A.range_shape):
        raise ValueError(
            f"expected views [1 1 m v u] {(1, 1, *A.range_shape)} of the operator, got "
            f"{tuple(views.shape)}"
        )
    check_finite(views)
    if not views.any():
        raise ValueError("expected views of an object to calibrate from, got zeros alone")


def _view_blur(A: Projector) -> float:
    """Blur of the views in pixels."""
    pixel = resolution(A.cameras.to("cpu"), A.grid.centre)
    return VIEW_BLUR * max(A.grid.spacing) / pixel
