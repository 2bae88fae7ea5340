"""Calibration from the measured views alone: the misalignment that makes them consistent with one
volume.

Rig and volume are fitted together by Gauss-Newton steps on |S y - A(rig) G x|, with views blurred
by S and a volume of Gaussian blobs, G: single voxels have enough degrees of freedom to explain a
tilted axis, too (wrongly by 0.4 degrees for a sharp object). Each step eliminates the rig's
unknowns exactly and finds the change of the volume by conjugate gradients (separable least squares:
Golub & Pereyra, SIAM J. Numer. Anal. 10, 1973; blobs: Lewitt, J. Opt. Soc. Am. A 7, 1990).

At the edge of a truncated view a blur has pixels on one side only, and what it makes of them is no
projection of a volume: in half acquisitions the fit was 1.2 pixels off. Of truncated views
|S (y - A(rig) G x)| is fitted, where S is along rows the square root of the ramp filter: A^T |f| A
is near the identity, so that conjugate gradients converge.

Discretisation errors bias every free parameter. Turning all detectors about u, say, is on a circle
nearly a stretch of the object, which voxels may resolve better: such a fit diverges while even its
prediction of held-out views improves. A parameter is therefore fitted only if the volume explains
its effect on the views far worse than the views themselves.
"""

import math
import warnings
from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from mvrecon.core.registry import hint
from mvrecon.geometry.cameras.camera import Cameras
from mvrecon.geometry.cameras.field import isocentre, resolution
from mvrecon.geometry.cameras.random_rigs import Misalignment, misaligned
from mvrecon.methods.calibration.alignment import Blur, RootRamp, blurred, least_deviations
from mvrecon.methods.classical.least_squares import cgls
from mvrecon.methods.classical.truncation import cut_sides, truncated_slices
from mvrecon.operators.checks import check_finite
from mvrecon.operators.operator import LinearOperator, Projector, Scaled, Symmetric


class Kind(NamedTuple):
    """A parameter of a view.

    Args:
        field, column: place of the parameter in `Misalignment`; None: the logarithm of the view's
            gain.
        longest: largest change in a round, in pixels, degrees or as a logarithm.
    """

    field: str | None
    column: int
    longest: float


KINDS = {
    "offset_u": Kind("offset_px", 0, 3.0),
    "offset_v": Kind("offset_px", 1, 3.0),
    "slant": Kind("tilt_degrees", 0, 3.0),
    "swivel": Kind("tilt_degrees", 1, 3.0),
    "tilt": Kind("tilt_degrees", 2, 3.0),
    "gain": Kind(None, 0, 0.3),
}
#: Parameters per view, and the kinds of parameters.
PER_VIEW_KINDS = {"shifts": ("offset_u", "offset_v"), "gains": ("gain",)}
#: Names that may be fitted; a common parameter has one value for all views.
MISALIGNMENTS = (*(name for name in KINDS if name != "gain"), *PER_VIEW_KINDS)


class Unknowns(NamedTuple):
    """The parameters of all views within the free subspace: values = basis z for any z.

    Args:
        kinds: names of the parameters of a view.
        basis: basis of the free values; its columns have unit length.
    """

    kinds: tuple[str, ...]
    basis: Float[Tensor, "m k n"]

    @property
    def longest(self) -> Float[Tensor, " k"]:
        """The largest change of each kind in a round."""
        return self.basis.new_tensor([KINDS[kind].longest for kind in self.kinds])

    def without(self, kinds: Sequence[str]) -> "Unknowns":
        """The same parameters, with some kinds fixed to zero in all views."""
        free = self.basis.new_tensor([kind not in kinds for kind in self.kinds])
        return self._replace(basis=self.basis * free[:, None])

    def misalignment(self, values: Float[Tensor, "m k"]) -> Misalignment:
        """The misalignment of each view, in pixels and degrees; differentiable."""
        still = Misalignment.none(len(values))
        fields = {name: list(getattr(still, name).unbind(dim=1)) for name in still._fields}
        for name, column in zip(self.kinds, values.unbind(dim=1), strict=True):
            if field := KINDS[name].field:
                fields[field][KINDS[name].column] = column
        return Misalignment(
            **{name: torch.stack(columns, dim=1) for name, columns in fields.items()}
        )

    def gains(self, values: Float[Tensor, "m k"]) -> Float[Tensor, " m"]:
        """The gain of each view, 1 if not free."""
        if "gain" not in self.kinds:
            return values.new_ones(len(values))
        return values[:, self.kinds.index("gain")].exp()


def unknowns(cameras: Cameras, free: Sequence[str]) -> Unknowns:
    """Return the parameters of the given names, without those that the views cannot determine.

    Shifts exclude motions of the object; the mean logarithm of the gains is zero, as a common
    factor belongs to the object.

    Args:
        cameras: the nominal rig.
        free: names out of `MISALIGNMENTS`.

    Raises:
        ValueError: no name, an unknown or repeated one, or one that is part of another; fewer than
            two views.
    """
    for name in free:
        if name not in MISALIGNMENTS:
            raise ValueError(f"Unknown misalignment {name!r}{hint(name, MISALIGNMENTS)}")
    single = {kind for name in free for kind in PER_VIEW_KINDS.get(name, ())}
    if not free or len(set(free)) < len(free) or single & set(free):
        raise ValueError(
            f"expected names out of {', '.join(MISALIGNMENTS)}, each once, and no offset together "
            f"with the shifts that contain it; got {', '.join(free) or 'none'}"
        )
    if len(cameras) < 2:
        raise ValueError(f"expected at least two views to calibrate from, got {len(cameras)}")
    views = len(cameras)
    kinds = tuple(k for k in KINDS if any(k in PER_VIEW_KINDS.get(name, (name,)) for name in free))
    blocks = []
    for name in free:
        parts = PER_VIEW_KINDS.get(name, (name,))
        rows = torch.arange(views)[:, None] * len(kinds) + torch.tensor(
            [kinds.index(kind) for kind in parts]
        )
        columns = _columns(cameras, name)
        block = columns.new_zeros(views * len(kinds), columns.shape[1])
        block[rows.flatten()] = columns
        blocks.append(block)
    return Unknowns(kinds, torch.cat(blocks, dim=1).reshape(views, len(kinds), -1))


def without_motion(cameras: Cameras, shifts: Float[Tensor, "m 2"]) -> Float[Tensor, "m 2"]:
    """Remove from shifts in pixels the part that a motion of the object explains (three degrees of
    freedom, at the isocentre).
    """
    rest = _complement(motions(cameras, isocentre(cameras)).flatten(0, 1))
    return (rest @ (rest.T @ shifts.reshape(-1, 1))).reshape(-1, 2)


def _columns(cameras: Cameras, name: str) -> Float[Tensor, "rows n"]:
    if name == "shifts":
        return _complement(motions(cameras, isocentre(cameras)).flatten(0, 1))
    same = torch.full((len(cameras), 1), len(cameras) ** -0.5, dtype=torch.float64)
    return _complement(same) if name in PER_VIEW_KINDS else same


def _complement(columns: Float[Tensor, "rows n"]) -> Float[Tensor, "rows k"]:
    """An orthonormal basis of the orthogonal complement of all columns."""
    return torch.linalg.qr(columns, mode="complete")[0][:, columns.shape[1] :]


def motions(cameras: Cameras, centre: Float[Tensor, "3"]) -> Float[Tensor, "m 2 3"]:
    """Pixels by which the image (u, v) of a point in world mm moves in each view for 1 mm along x,
    y and z.
    """
    uvw = torch.linalg.inv(cameras.frame)
    if cameras.parallel:
        return uvw[:, :2]
    at = uvw @ (centre.to(cameras.source) - cameras.source)[..., None]
    u_v, w = at[:, :2], at[:, 2:]
    return (uvw[:, :2] - u_v / w * uvw[:, 2:]) / w


#: Half step of difference quotients, in pixels (degrees, hundredths of a gain's logarithm).
HALF_STEP = 0.1


def derivatives(
    views_at: Callable[[Tensor], Tensor], values: Float[Tensor, "m k"]
) -> Float[Tensor, "k m v u"]:
    """Derivatives of each view with respect to its own parameters, by central differences.

    All views are perturbed at once, as each depends on its own parameters only. Kernels
    differentiate poses in reverse mode only, and the reference's forward mode takes some sixty
    times as long.

    Args:
        views_at: maps parameters to the views [1 1 m v u] of a volume.
        values: the parameters.
    """
    columns = []
    for direction in HALF_STEP * torch.eye(values.shape[1], dtype=values.dtype):
        ahead, behind = (views_at(values + side * direction) for side in (1, -1))
        columns.append((ahead - behind)[0, 0] / (2 * HALF_STEP))
    return torch.stack(columns)


class Complement(Symmetric):
    """Orthogonal projection of views onto the part that no change of the rig's parameters explains.

    Args:
        columns: derivatives of each view with respect to its own parameters.
        unknowns: the free parameters.
    """

    def __init__(self, columns: Float[Tensor, "k m v u"], unknowns: Unknowns):
        super().__init__(columns.shape[1:], columns.device)
        self.columns, basis = columns, unknowns.basis
        flat = columns.flatten(2).double()
        gram = torch.einsum("kmp,lmp->mkl", flat, flat).to(basis)
        normal = torch.einsum("mkn,mkl,mlo->no", basis, gram, basis)
        self._solution = basis @ torch.linalg.pinv(normal, rtol=1e-9, hermitian=True)
        self._basis = basis

    def change(self, views: Float[Tensor, "1 1 m v u"]) -> Float[Tensor, "m k"]:
        """The least-squares change of the parameters that explains the views."""
        products = torch.einsum("kmvu,mvu->mk", self.columns, views[0, 0]).to(self._basis)
        return self._solution @ torch.einsum("mkn,mk->n", self._basis, products)

    def forward(self, x: Float[Tensor, "1 1 m v u"]) -> Float[Tensor, "1 1 m v u"]:
        explained = torch.einsum("kmvu,mk->mvu", self.columns, self.change(x).to(self.columns))
        return x - explained


OperatorOf = Callable[[Cameras], Projector]

#: Standard deviation of a blob in voxels, and of the views' blur in voxels' images.
BLOB_SIGMA, VIEW_BLUR_SIGMA = 1.0, 2.0
#: The fit ends when no parameter changes by this part of its largest change.
MAX_FINAL_CHANGE = 2e-3
#: The views determine a parameter if the ratio of unexplained to explained effect exceeds that of
#: the views so many times.
MIN_DETERMINED_RATIO = 10.0
#: The same of truncated slices, of the effect alone: 0.17 of an offset over a half turn of parallel
#: beams, which is found 1.2 pixels off, 0.33 and more of one that is found.
MIN_UNEXPLAINED_TRUNCATED = 0.25
#: Uncertainty of a parameter, relative to the change that has as much effect as all that stays
#: unexplained. Errors of balls, ellipsoids and rods are 0.01 to 0.4 of that change, one is 1.0.
UNCERTAIN_SHARE = 1 / 3
#: Shifts in pixels below which a view counts as right.
MIN_SHIFT_PX = 0.03
#: Folds of the cross-validation over views, and the error of held-out views from which on others
#: do not predict them, be the rig right or wrong.
FOLDS, MAX_LEFT_OUT = 2, 0.5


class Round(NamedTuple):
    """A round of the fit, as passed to a monitor.

    Args:
        number: number of the round, from 1, and again from 1 after undetermined parameters are
            fixed.
        residual: final |S y - A x| / |S y| of the blurred views.
    """

    number: int
    residual: float


class Estimate(NamedTuple):
    """A calibrated rig.

    Args:
        cameras: the rig.
        misalignment: misalignment of each view relative to the nominal rig, in pixels and degrees.
        gains: factor of each view's integrals, their geometric mean 1; to be divided by.
        residual: |S y - A x| / |S y| of the blurred views, for the nominal rig and after each
            round.
        kept: names out of `free`, or of `KINDS` where it is a part of one, that stayed nominal.
        left_out: |S y - A x| / |S y| of held-out views, for the nominal rig with what is known, and
            for the fitted one.
        settled: whether the fit converged before the last round.
        uncertainty: uncertainty of each kind of parameter that was fitted, out of `KINDS`, in its
            unit.
    """

    cameras: Cameras
    misalignment: Misalignment
    gains: Float[Tensor, " m"]
    residual: list[float]
    kept: list[str]
    left_out: tuple[float, float]
    settled: bool
    uncertainty: dict[str, float]


class _Fit(NamedTuple):
    """Parameters and volume, the residuals of all rounds, and whether the fit converged."""

    values: Float[Tensor, "m k"]
    x: Float[Tensor, "1 1 d h w"]
    residual: list[float]
    settled: bool


class Problem(NamedTuple):
    """Filtered views, the operator on volumes of blobs, and the rig's parameters.

    Args:
        filter: filter of the volume's views; None: those of complete views need none.
        least: part of a parameter's effect, relative to the explained one, that must stay
            unexplained for the views to determine it.
    """

    operator_of: OperatorOf
    cameras: Cameras
    unknowns: Unknowns
    blobs: Blur
    views: Float[Tensor, "1 1 m v u"]
    filter: Callable[[tuple[int, ...]], LinearOperator] | None
    least: float = 0.0

    def rig(self, values: Float[Tensor, "m k"]) -> Cameras:
        return misaligned(self.cameras, self.unknowns.misalignment(values))

    def operator(self, values: Float[Tensor, "m k"]) -> LinearOperator:
        """The map from a volume's coefficients to its views."""
        A = self.operator_of(self.rig(values))
        if "gain" in self.unknowns.kinds:
            A = Scaled(A, pixels=self.unknowns.gains(values)[:, None, None].to(A.device))
        return self.of_blobs(A)

    def of_blobs(self, A: LinearOperator) -> LinearOperator:
        """The same of any views' operator."""
        A = A @ self.blobs
        return A if self.filter is None else self.filter(A.range_shape) @ A

    def residual(self, values: Float[Tensor, "m k"], x: Float[Tensor, "1 1 d h w"]) -> Tensor:
        return self.views - self.operator(values)(x)

    def relative(self, values: Float[Tensor, "m k"], x: Float[Tensor, "1 1 d h w"]) -> float:
        return (self.residual(values, x).norm() / self.views.norm()).item()

    def left_out(self, values: Float[Tensor, "m k"], iterations: int) -> float:
        """The relative error of held-out views as predicted from the others."""
        rig = self.rig(values)
        views = self.views / self.unknowns.gains(values)[:, None, None].to(self.views)
        part, squares = torch.arange(len(rig)) % FOLDS, 0.0
        for fold in range(FOLDS):
            out, others = part == fold, part != fold
            A, B = (self.of_blobs(self.operator_of(rig[some])) for some in (others, out))
            rest = views[:, :, out] - B(cgls(A, views[:, :, others], iterations))
            squares += rest.square().sum().item()
        return squares**0.5 / views.norm().item()


@torch.no_grad()
def calibrated(
    operator_of: OperatorOf,
    cameras: Cameras,
    views: Float[Tensor, "1 1 m v u"],
    free: Sequence[str] = ("offset_u", "tilt"),
    iterations: int = 15,
    rounds: int = 12,
    monitor: Callable[[Round], object] | None = None,
    known: Mapping[str, float] | None = None,
) -> Estimate:
    """Fit a rig to the measured views alone.

    Parameters that the views do not determine keep their nominal values; the nominal rig is kept if
    it predicts held-out views best, or if the fitted one predicts them badly, as of few views. The
    nominal rig is the result, with the fit's uncertainty, if they differ by less than that and it
    predicts best.
    Blobs and blur scale with the grid's voxel. Coarse voxels are fast and robust: edges need not be
    resolved, but there should be about as many views as voxels across. The object must be inside
    the grid and inside all views. Empty views are left out: their own shifts are 0, their gains 1.

    Args:
        operator_of: the operator of a rig, such as `partial(Drr, grid)`.
        cameras: the nominal rig.
        views: measured integrals.
        free: parameters to fit. Common to all views: "offset_u", "offset_v" (pixels), "tilt" (about
            the beam: the tilt of the axis), "slant" (about u), "swivel" (about v; degrees). Per
            view: "shifts" (u and v, pixels; up to a motion of the object, the one by which most
            views have none), "gains" (factors). On a circle an offset_v is nearly a
            shift of the object, a slant nearly a stretch.
        iterations: number of conjugate-gradient iterations per round.
        rounds: maximum number of Gauss-Newton steps.
        monitor: called after each round.
        known: common values out of `free` that are found otherwise, in pixels or degrees; they
            stay.

    Returns:
        The fitted rig, with the misalignment and the gain of each view, and the residual of each
        round.

    Warns:
        UserWarning: nominal values are kept; the rig still changed in the last round.

    Raises:
        ValueError: names as in `unknowns`; views that are zero, not finite, or of another shape
            than the operator's.

    Examples:
        >>> from functools import partial
        >>> rig = mv.circular(8, sid=200, sdd=300, detector={"pixels": [12, 16], "pixel_mm": 9.0})
        >>> A_of = partial(mv.Drr, mv.Grid.centred(8, spacing=4.0))  # the operator of a rig
        >>> views = A_of(rig)(torch.nn.functional.pad(torch.ones(1, 1, 4, 4, 4), [2] * 6))
        >>> fit = mv.calibrated(A_of, rig, views.roll(1, dims=-1), free=["offset_u"], iterations=5)
        >>> round(fit.misalignment.offset_px[0, 0].item(), 1)  # pixels
        -1.0
    """
    every = unknowns(cameras, free)
    A = operator_of(misaligned(cameras, Misalignment.none(len(cameras))))
    if tuple(views.shape) != (1, 1, *A.range_shape):
        raise ValueError(
            f"expected views [1 1 m v u] {(1, 1, *A.range_shape)} of the operator, got "
            f"{tuple(views.shape)}"
        )
    check_finite(views)
    if not views.any():
        raise ValueError("expected views of an object to calibrate from, got only zeros")
    blur_px = VIEW_BLUR_SIGMA * max(A.grid.spacing) / resolution(A.cameras.to("cpu"), A.grid.centre)
    blobs = Blur(A.domain_shape, [BLOB_SIGMA] * 3, A.device)
    seen = views.any(dim=4).any(dim=3)[0, 0].cpu()  # an empty view has neither gain nor shift
    numbers, views = unknowns(cameras[seen], free), views[:, :, seen]
    nominal = numbers.basis.new_zeros(numbers.basis.shape[:2])
    known = known or {}
    start = nominal + nominal.new_tensor([known.get(kind, 0.0) for kind in numbers.kinds])
    kept = [kind for kind in _motions_of_the_object(free, cameras[seen]) if kind not in known]
    numbers = numbers.without([*kept, *known])
    cut = cut_sides(views).any()

    def of_rows(shape: Sequence[int]) -> LinearOperator:
        ramp = RootRamp(shape, min(1.0, VIEW_BLUR_SIGMA / blur_px / 2), A.device)
        return Blur(shape, (0.0, blur_px, 0.0), A.device) @ ramp

    smooth = of_rows(views.shape[2:])(views) if cut else blurred(views, blur_px)
    truncated = truncated_slices(views, cameras[seen]).any()
    least = MIN_UNEXPLAINED_TRUNCATED if truncated else 0.0
    filter = of_rows if cut else None
    problem = Problem(operator_of, cameras[seen], numbers, blobs, smooth, filter, least)
    while True:
        fit = _fitted(problem, start, iterations, rounds, monitor)
        uncertainty = _uncertainties(problem, fit, iterations)
        lost = [kind for kind, size in uncertainty.items() if size == math.inf]
        if not lost:
            break
        kept += lost
        problem = problem._replace(unknowns=problem.unknowns.without(lost))
    if kept:
        warnings.warn(
            f"The views do not determine {', '.join(kept)}: kept at the nominal value",
            stacklevel=3,
        )
    if not fit.settled:
        warnings.warn(f"The rig still changed in the last of {rounds} rounds", stacklevel=3)
    values = fit.values
    left_out = (problem.left_out(start, iterations), problem.left_out(values, iterations))
    if (values != start).any() and left_out[1] > min(left_out[0], MAX_LEFT_OUT):
        within = values.new_tensor([uncertainty.get(kind, 0.0) for kind in numbers.kinds])
        # of a rig that is right, the fit finds as much, up to its uncertainty
        if left_out[1] > MAX_LEFT_OUT or ((values - start).abs() > within).any():
            warnings.warn(
                f"The nominal rig predicts left-out views with an error of {left_out[0]:.5g}, the "
                f"fitted one with {left_out[1]:.5g} (expected less, and at most {MAX_LEFT_OUT}): "
                f"the nominal rig is kept",
                stacklevel=3,
            )
            kept, uncertainty = [name for name in free if name not in known], {}
        values = start
    single = [kind for name in free for kind in PER_VIEW_KINDS.get(name, ())]
    common = values.new_tensor([kind not in single for kind in every.kinds])
    whole = (values[0] * common).repeat(len(cameras), 1)
    whole[seen] = values
    by, gains = every.misalignment(whole), every.gains(whole)
    if "shifts" in free and values.any():
        moves = motions(cameras[seen], isocentre(cameras))
        by.offset_px[seen] = least_deviations(by.offset_px[seen][None], moves, MIN_SHIFT_PX)[0]
    rig = misaligned(cameras, by)
    return Estimate(rig, by, gains, fit.residual, kept, left_out, fit.settled, uncertainty)


def _motions_of_the_object(free: Sequence[str], cameras: Cameras) -> list[str]:
    """The names of common offsets of parallel beams that are exactly a motion of the object, as
    offset_v along an axis of rotation.
    """
    if not cameras.parallel:
        return []
    rest = _complement(motions(cameras, isocentre(cameras)).flatten(0, 1))
    names = []
    for column, name in enumerate(("offset_u", "offset_v")):
        shift = torch.eye(2, dtype=rest.dtype)[column].repeat(len(cameras))
        if name in free and (rest.T @ shift).norm() < 1e-6 * shift.norm():
            names.append(name)
    return names


def _fitted(
    problem: Problem,
    start: Float[Tensor, "m k"],
    iterations: int,
    rounds: int,
    monitor: Callable[[Round], object] | None,
) -> _Fit:
    """Fit rig and volume, from a start."""
    values = torch.zeros_like(start)
    x = cgls(problem.operator(values), problem.views, iterations)
    history = [problem.relative(values, x)]
    if start.any():
        values, x = start, cgls(problem.operator(start), problem.views, iterations)
    for number in range(1, rounds + 1):
        last = values
        values, x = improved(problem, values, x, iterations)
        history.append(problem.relative(values, x))
        if monitor is not None:
            monitor(Round(number, history[-1]))
        if ((values - last).abs() < MAX_FINAL_CHANGE * problem.unknowns.longest).all():
            return _Fit(values, x, history, True)
    return _Fit(values, x, history, False)


def _uncertainties(problem: Problem, fit: _Fit, iterations: int) -> dict[str, float]:
    """The uncertainty of each free kind of parameter, in pixels, degrees or as a logarithm;
    infinite where the volume explains its effect about as well as it explains the views, or where
    its largest change in a round has less effect than stays unexplained of the views.

    What stays unexplained moves a parameter at most by its norm over that of what neither the
    volume nor another parameter explains of its effect; of single views', with random signs.
    """
    A, r = problem.operator(fit.values), problem.residual(fit.values, fit.x)
    columns = derivatives(lambda moved: problem.operator(moved)(fit.x), fit.values)
    least, result = max(problem.least, MIN_DETERMINED_RATIO * _unexplained(r, problem.views)), {}
    numbers, rng = problem.unknowns, torch.Generator().manual_seed(0)
    signs = (torch.randint(2, (len(columns[0]), 1, 1), generator=rng) * 2 - 1).to(columns)
    for kind, column, basis in zip(numbers.kinds, columns, numbers.basis.unbind(1), strict=True):
        if not basis.any():
            continue
        others = Complement(columns, numbers.without([kind]))
        common = (basis - basis[0]).abs().max() < 1e-9
        effect = others((column if common else signs * column)[None, None])
        rest = effect - others(A(cgls(others @ A, effect, iterations)))
        most = (r.norm() / rest.norm()).item()
        known = most < KINDS[kind].longest and _unexplained(rest, effect) >= least
        result[kind] = UNCERTAIN_SHARE * most if known else math.inf
    return result


def _unexplained(rest: Tensor, whole: Tensor) -> float:
    """The norm of views that a volume does not explain, relative to the explained part."""
    return (rest.norm() / (whole - rest).norm()).item()


def improved(
    problem: Problem, values: Float[Tensor, "m k"], x: Float[Tensor, "1 1 d h w"], iterations: int
) -> tuple[Float[Tensor, "m k"], Float[Tensor, "1 1 d h w"]]:
    """One Gauss-Newton step of the rig's parameters and the volume."""
    A, r = problem.operator(values), problem.residual(values, x)
    columns = derivatives(lambda moved: problem.operator(moved)(x), values)
    rest = Complement(columns, problem.unknowns)
    change = cgls(rest @ A, rest(r), iterations)
    longest = problem.unknowns.longest
    step = rest.change(r - A(change)).clamp(-longest, longest)
    return values + step, x + change
