"""Shifts and gains of misaligned cameras from the measured views alone, alternating with
reconstruction.

Views are reconstructed, aligned with the volume's views, and reconstructed again (alignment by
re-projection: Dengler, Ultramicroscopy 30, 1989). Common modes of all cameras - motion of the
object, its scale - are chosen by least absolute deviations, such that most cameras have no error;
few misaligned cameras do not affect these (Bloomfield & Steiger, Least Absolute Deviations, 1983).
"""

import warnings
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from mvrecon.core.numbers import divided
from mvrecon.core.parts import MethodPart
from mvrecon.core.quantities import PositiveInt
from mvrecon.kernels.operator import to_accumulation_dtype
from mvrecon.methods.calibration.alignment import (
    BLUR_SIGMA_PX,
    MAX_SHIFT_PX,
    aligned,
    alignment,
    blurred,
    least_deviations,
    translated,
)
from mvrecon.methods.calibration.from_data import motions
from mvrecon.methods.classical.sirt import SirtWeights, inverse_sums, sirt, sirt_weights
from mvrecon.methods.classical.solver import check_no_gradient
from mvrecon.methods.classical.truncation import CUT_EDGE, MAX_AIR, MAX_AIR_SHARE, truncated_slices
from mvrecon.methods.learned.start import CaseCache
from mvrecon.methods.method import Alignment, Reconstruction, build_method
from mvrecon.operators.checks import check_finite, check_views
from mvrecon.operators.memo import grid_key, kept, place
from mvrecon.operators.operator import LinearOperator, Projector
from mvrecon.operators.selection import view_subset

#: Shifts in pixels, and gains, below which a camera counts as error-free.
MIN_SHIFT_PX, MIN_LOG_GAIN = 0.03, 0.003
#: Gains whose logarithms are this far from the median are tried, and used where they leave less
#: than this part of the relative residual of their views, or of all.
MIN_OUTLYING_LOG_GAIN, MAX_RESIDUAL_RATIO = 0.2, 0.6
#: Error of left-out views as the aligned others predict them, relative to that as the measured ones
#: do, up to which views are aligned, and where they end inside the object, up to which they are
#: shifted, or shifted and scaled: shifts and gains then also make up for what lies beside the
#: detector. Right half panels over half a turn have 0.94 to 1.2 and 0.82 to 1.3, with 0.85 or more
#: of it by gains; wrong gains have 0.33 to 0.60.
MAX_PREDICTION_RATIO, MAX_CUT_RATIOS = 0.95, (0.9, 0.72)
#: Share of the line integrals outside the grid from which on the object extends beyond it: views of
#: a body are aligned on a grid that misses 0.003 of them, and no longer where it misses 0.007.
#: Standard deviation in pixels of the blur that takes noise off these.
MAX_BESIDE, BESIDE_BLUR_PX = 0.005, 2.0
#: Iterations of SIRT with momentum from zero; after fewer, gains make up for what has not yet
#: converged: after 8, those of half panels over half a turn raised the error by two fifths.
ITERATIONS_FROM_ZERO = 30
#: Folds of the views that the others predict, and most rounds, each without the views lost in the
#: last and with the gains found until then.
FOLDS, MAX_ROUNDS = 4, 4
#: A view is lost if its prediction explains less of its square sum than the first part of what is
#: explained of the best quarter of the views, or less than the second part and leaves more than so
#: many times the residual of a constant; an empty view if the projection of the volume of all
#: views, itself included, has more than the last part of the others' median norm: right ones have
#: 0.02 to 0.16, right ones beside dead ones 0.04 to 0.23, dead ones 0.4 to 1.8, and 0.23 to 0.85
#: where thin rays miss most voxels. More iterations would put the object between such rays.
MIN_EXPLAINED, MIN_FAIRLY_EXPLAINED, MAX_CONSTANT_RATIO = 0.1, 0.9, 2.0
MAX_EMPTY_NORM, EMPTY_ITERATIONS = 0.25, 12


class CorrectedViews(NamedTuple):
    """Aligned views.

    Args:
        views: aligned views, in the unit of the measured ones; float32 of half precision.
        alignment: estimated errors of the cameras.
    """

    views: Float[Tensor, "b 1 m v u"]
    alignment: Alignment


@torch.no_grad()
def self_aligned(
    A: Projector,
    views: Float[Tensor, "b 1 m v u"],
    alternations: PositiveInt = 4,
    iterations: PositiveInt = 8,
) -> CorrectedViews:
    """Estimate shifts (pixels) and gains from the views alone, and correct the views.

    The errors are returned as `alignment`. A lost view (see `agreement`; gain 0) is replaced by
    the projection of the volume of all others, as in expectation maximisation with missing data.
    Where more than half of the views are lost, nothing is estimated: all views are returned as
    measured, with an alignment of `Alignment.none`. Views are shifted, or shifted and scaled, only
    where they then predict one another better; else their shifts are 0 and their gains 1.

    Args:
        A: the operator of the nominal cameras; its grid must hold the whole object.
        alternations: number of alternations of reconstruction and alignment.
        iterations: number of iterations of SIRT with momentum in each but the first, from the
            previous volume.

    Warns:
        UserWarning: truncated views, or those of an object that extends beyond the grid, are not
            aligned (not on a GPU).

    Raises:
        ValueError: non-finite views (not checked on a GPU, where the volume then is not finite
            either), or no alternation.
    """
    if alternations < 1:
        raise ValueError(f"expected at least one alternation, got {alternations}")
    check_finite(views, on_gpu=False)
    views = to_accumulation_dtype(views)
    by, volume, expected = Alignment.none(views), None, views
    weights = sirt_weights(A, views.dtype)
    cameras, centre = A.cameras, A.grid.centre
    moves = kept(
        cameras,
        ("motions", grid_key(A.grid), place(views)),
        lambda: motions(cameras, centre).detach().to(views.device),
    )
    lost, level = agreement(A, views, weights)
    measured, views = views, views / level[:, None, :, None, None]
    many = lost.sum(dim=1, keepdim=True) > lost.shape[1] / 2
    dropped = lost & ~many
    present = (~dropped)[:, None, :, None, None].to(views)
    weights = _among(A, present.expand_as(views), weights)
    count = max(iterations, ITERATIONS_FROM_ZERO)
    for _ in range(alternations):
        y = aligned(views, by)
        volume = sirt(A, y, count, weights=weights, momentum=True, start=volume)
        expected, count = A(volume), iterations
        fitted = alignment(_filled(views, dropped, expected), expected, start=by, steps=1)
        by = standing_still(fitted, moves)
    gain = _relative(level * by.gain, ~dropped)
    by = replace(by, gain=gain.masked_fill(dropped, 0))
    still = Alignment.none(views)
    pairs = zip(still.tensors(), by.tensors(), strict=True)
    by = Alignment(*(torch.where(many.view(-1, *[1] * (b.ndim - 1)), a, b) for a, b in pairs))
    return _best(A, _filled(measured, dropped, expected), by)


def share_beside(A: LinearOperator, views: Float[Tensor, "b 1 m v u"]) -> Float[Tensor, " b"]:
    """The share of the line integrals in pixels whose rays miss an operator's grid and that exceed
    the reading of air by more than `CUT_EDGE` of the mean line integral, which is weighted by
    itself, so that neither air, metal nor a hot pixel determines the threshold. The reading of air
    is the median of these pixels if a flat field may be as far off, else zero.
    """
    dims = (1, 2, 3, 4)
    missed = A(torch.ones(1, 1, *A.domain_shape, device=A.device))[0, 0] == 0
    beside = views[..., missed]
    if not beside.shape[-1]:
        return views.new_zeros(len(views))
    level = divided(views.square().sum(dims, True), views.sum(dims, True))
    air = beside.median(dim=-1).values[..., None, None, None]
    air = air * (air < (MAX_AIR_SHARE * level).clamp_max(MAX_AIR))
    shown = views - air
    above = blurred(shown, BESIDE_BLUR_PX, missed) > CUT_EDGE * level
    return divided((shown * (above & missed)).sum(dims), shown.sum(dims))


def _best(A: Projector, measured: Float[Tensor, "b 1 m v u"], by: Alignment) -> CorrectedViews:
    """The views of each sample as measured, shifted, or shifted and scaled: the best of which half
    predicts the other half, with its estimated errors. Corrections must reduce the error clearly.

    The views as measured are predicted, as interpolated ones are smoother and so are easier to
    predict.
    """
    lost = by.gain == 0
    shifted = replace(by, gain=torch.ones_like(by.gain).masked_fill(lost, 0))
    if measured.shape[2] < 2:  # no other view predicts it
        return CorrectedViews(measured, replace(shifted, shift_px=torch.zeros_like(by.shift_px)))
    halves = [view_subset(A, range(first, measured.shape[2], 2)) for first in (0, 1)]
    best = (measured, torch.zeros_like(by.shift_px), shifted.gain)
    least = _prediction_error(halves, measured, *best)
    cut = truncated_slices(measured, A.cameras)
    # a GPU would have to be waited for
    unaligned = cut if measured.is_cuda else cut | (share_beside(A, measured) > MAX_BESIDE)
    for tried, most in zip((shifted, by), MAX_CUT_RATIOS, strict=True):
        trial = (_filled(aligned(measured, tried), lost, measured), tried.shift_px, tried.gain)
        error = _prediction_error(halves, measured, *trial)
        error = error / torch.where(cut, most, MAX_PREDICTION_RATIO)
        better, least = error < least, torch.minimum(error, least)
        pairs, unaligned = zip(trial, best, strict=True), unaligned & ~better
        best = [torch.where(better.view(-1, *[1] * (a.ndim - 1)), a, b) for a, b in pairs]
    if not measured.is_cuda and (unaligned & (by.gain_error > 0).any(dim=1)).any():
        # the check would synchronise
        warnings.warn(
            "Views end inside the object, or it extends beyond the grid, and aligned ones predict "
            "one another hardly better: they are not aligned; take a detector that sees the whole "
            "object, and a grid that holds it",
            stacklevel=3,
        )
    views, shift, gain = best
    return CorrectedViews(views, replace(by, shift_px=shift, gain=gain))


def _prediction_error(
    halves: Sequence[LinearOperator],
    measured: Float[Tensor, "b 1 m v u"],
    views: Float[Tensor, "b 1 m v u"],
    shift_px: Float[Tensor, "b m 2"],
    gain: Float[Tensor, "b m"],
) -> Float[Tensor, " b"]:
    """Norm of what either half of corrected views misses of the other half as measured, in views
    whose gain is not 0.
    """
    parts = [slice(first, None, 2) for first in (0, 1)]
    squares = views.new_zeros(len(views))
    for B, some, C, others in zip(halves, parts, halves[::-1], parts[::-1], strict=True):
        x = sirt(B, views[:, :, some].contiguous(), ITERATIONS_FROM_ZERO, momentum=True)
        scale = gain[:, None, others, None, None]
        rest = translated(C(x), shift_px[:, others]) * scale - measured[:, :, others] * (scale != 0)
        squares = squares + rest.square().sum(dim=(1, 2, 3, 4))
    return squares.sqrt()


def warn_unless_aligned(by: Alignment) -> None:
    """Warn of samples whose views `self_aligned` returned as measured.

    Warns:
        UserWarning: more than half of a sample's views are lost.
    """
    if not by.gain_error.any(dim=1).all():
        warnings.warn(
            f"Expected at least half of the {by.gain.shape[1]} views to be predicted by the "
            f"others, got fewer: no view is aligned or replaced; leave out those that are empty, "
            f"overexposed or noise",
            stacklevel=3,
        )


def agreement(
    A: Projector, views: Float[Tensor, "b 1 m v u"], weights: SirtWeights
) -> tuple[Bool[Tensor, "b m"], Float[Tensor, "b m"]]:
    """Compare each view with what the others predict.

    Each view is compared with its prediction from the other folds' views up to a gain and a shift
    of at most `MAX_SHIFT_PX` pixels, so neither makes it lost. Empty views predict nothing. Views
    that are not explained are left out of the next round's predictions, at most half of them, as
    they and their gains, which are arbitrary, would spoil these; the others are divided by theirs.
    At most half of the views are lost only if the others predict one another better without them.

    Args:
        A: the operator of the nominal cameras.
        views: measured views.
        weights: weights as `sirt_weights` returns them.

    Returns:
        The views that the others do not predict: empty, overexposed, or noise; and the gain of each
        view relative to the others', 1 unless it makes the views more consistent.
    """
    blank = ~views.flatten(3).any(dim=3)[:, 0]
    smooth = blurred(views, BLUR_SIGMA_PX)
    squares = smooth.square().mean(dim=(3, 4))[:, 0]
    uneven = 1 - divided(smooth.mean(dim=(3, 4))[:, 0].square(), squares)
    keep, unlike = ~blank, torch.zeros_like(blank)
    gain = torch.ones_like(squares)
    for _ in range(MAX_ROUNDS):
        by = gain[:, None, :, None, None]
        predicted = blurred(_predicted(A, views / by, keep, weights), BLUR_SIGMA_PX)
        explained, change = _explained(smooth / by, predicted)
        excess = (1 - explained) - MAX_CONSTANT_RATIO * uneven
        best = explained.masked_fill(blank, torch.nan).nanquantile(0.75, dim=1, keepdim=True)
        unexplained = explained < MIN_EXPLAINED * best
        levelled = (explained < MIN_FAIRLY_EXPLAINED) & (excess > 0)
        unlike = (unexplained | levelled) & ~blank
        change, before = _relative(change, keep & ~unexplained), keep
        gain = torch.where(unexplained, 1.0, gain * change)
        # the worst first, as they spoil the predictions of all others
        rank = excess.masked_fill(~unlike, -torch.inf).argsort(1, True).argsort(1)
        keep = ~blank & ~(unlike & (rank < rank.shape[1] // 2))
        if (
            not views.is_cuda
            and keep.equal(before)
            and (change.log().abs() < MIN_OUTLYING_LOG_GAIN).all()
        ):
            break  # the next round would be as this one
    level = _relative(gain, ~unlike & ~blank).log()
    outlying = level.abs().amax(dim=1, keepdim=True) > MIN_OUTLYING_LOG_GAIN
    gain = torch.where(outlying & ~(unlike | blank), level, 0.0).exp()
    lost = unlike
    if views.is_cuda or blank.any() or (gain != 1).any():  # else no gain to try, no empty view
        gain = _consistent(A, views, gain, ~unlike & ~blank, weights)
        # the object may lie where empty views alone would have seen it, so they are included
        part = _among(A, (~unlike)[:, None, :, None, None].to(views).expand_as(views), weights)
        y = views / gain[:, None, :, None, None]
        fit = A(sirt(A, y, EMPTY_ITERATIONS, weights=part, momentum=True))
        norm = torch.linalg.vector_norm(fit, dim=(1, 3, 4))
        usual = norm.masked_fill(blank, torch.nan).nanmedian(dim=1, keepdim=True).values
        lost = unlike | (blank & (norm > MAX_EMPTY_NORM * usual))
    if not views.is_cuda and not lost.any():
        return lost, gain
    many = 2 * lost.sum(dim=1) > lost.shape[1]
    better = _predict_better_without(A, views / gain[:, None, :, None, None], lost, weights)
    return lost & (many | better)[:, None], gain


def _predict_better_without(
    A: Projector, views: Float[Tensor, "b 1 m v u"], lost: Bool[Tensor, "b m"], weights: SirtWeights
) -> Bool[Tensor, " b"]:
    """Whether the other views predict one another better without the lost ones than with them."""
    others = (~lost)[:, None, :, None, None]
    errors = [
        (others * (_predicted(A, views, keep, weights) - views)).square().sum(dim=(1, 2, 3, 4))
        for keep in (~lost, torch.ones_like(lost))
    ]
    return errors[0] < errors[1]


def _consistent(
    A: Projector,
    views: Float[Tensor, "b 1 m v u"],
    gain: Float[Tensor, "b m"],
    keep: Bool[Tensor, "b m"],
    weights: SirtWeights,
) -> Float[Tensor, "b m"]:
    """The gains of samples whose views they make much more consistent, else 1."""
    kept = keep[:, None, :, None, None].to(views)
    part = _among(A, kept.expand_as(views), weights)
    outlying = (gain.log().abs() > MIN_OUTLYING_LOG_GAIN)[:, None, :, None, None]
    tried, rests = kept * outlying, []
    for y in (views / gain[:, None, :, None, None], views):
        rest = A(sirt(A, y, ITERATIONS_FROM_ZERO, weights=part, momentum=True)) - y
        sums = [(some * y).square().sum(dim=(1, 2, 3, 4)) for some in (tried, kept)]
        left = [(some * rest).square().sum(dim=(1, 2, 3, 4)) for some in (tried, kept)]
        rests.append([divided(a, b) for a, b in zip(left, sums, strict=True)])
    (of_tried, of_all), (of_tried_before, of_all_before) = rests
    much = (of_tried < MAX_RESIDUAL_RATIO**2 * of_tried_before) | (
        of_all < MAX_RESIDUAL_RATIO**2 * of_all_before
    )
    return torch.where((much & (of_all < of_all_before))[:, None], gain, 1.0)


def _relative(gain: Float[Tensor, "b m"], among: Bool[Tensor, "b m"]) -> Float[Tensor, "b m"]:
    """Gains relative to the median of some views'; one where there is none."""
    level = gain.log().masked_fill(~among | (gain <= 0), torch.nan)
    return (level - level.nanmedian(dim=1, keepdim=True).values).nan_to_num(0.0).exp()


def _among(A: Projector, kept: Float[Tensor, "b 1 m v u"], weights: SirtWeights) -> SirtWeights:
    """SIRT's weights of the kept views alone."""
    return SirtWeights(weights.row * kept, inverse_sums(A.T(kept.contiguous())))


def _predicted(
    A: Projector, views: Float[Tensor, "b 1 m v u"], keep: Bool[Tensor, "b m"], weights: SirtWeights
) -> Float[Tensor, "b 1 m v u"]:
    """Each view as the kept ones of the other folds predict it."""
    fold = torch.arange(views.shape[2], device=views.device) % FOLDS
    result = torch.zeros_like(views)
    for number in range(min(FOLDS, views.shape[2])):
        out = fold == number
        kept = (keep & ~out)[:, None, :, None, None].to(views)
        part = _among(A, kept.expand_as(views), weights)
        x = sirt(A, views, ITERATIONS_FROM_ZERO, weights=part, momentum=True)
        result = torch.where(out[:, None, None], A(x), result)
    return result


def _explained(
    views: Float[Tensor, "b 1 m v u"], predicted: Float[Tensor, "b 1 m v u"]
) -> tuple[Float[Tensor, "b m"], Float[Tensor, "b m"]]:
    """The part of each view's square sum that its prediction explains with the best gain and whole
    shift of up to `MAX_SHIFT_PX` pixels, and this gain.
    """
    size = tuple(count + MAX_SHIFT_PX for count in views.shape[-2:])
    spectra = (torch.fft.rfft2(x, s=size) for x in (views, predicted))
    product = torch.fft.irfft2(next(spectra).conj() * next(spectra), s=size)
    shifts = torch.arange(-MAX_SHIFT_PX, MAX_SHIFT_PX + 1, device=views.device)
    near = product[..., shifts % size[0], :][..., shifts % size[1]].flatten(3).amax(dim=3)
    near, norm = near.clamp_min(0)[:, 0], predicted.square().sum(dim=(3, 4))[:, 0]
    gain = divided(near, norm)
    return divided(gain * near, views.square().sum(dim=(3, 4))[:, 0]), gain


def _filled(
    views: Float[Tensor, "b 1 m v u"],
    lost: Bool[Tensor, "b m"],
    expected: Float[Tensor, "b 1 #m v u"],
) -> Float[Tensor, "b 1 m v u"]:
    """Replace lost views by the expected ones."""
    return torch.where(lost[:, None, :, None, None], expected, views)


def standing_still(by: Alignment, moves: Float[Tensor, "m 2 3"]) -> Alignment:
    """Remove a motion of the object from an alignment's shifts (pixels) and a common factor from
    its gains, such that most cameras have no error.

    Otherwise an object that misaligned cameras have displaced is taken for the true one.

    Args:
        by: the alignment.
        moves: effect of a motion of the object in the views, by `motions`.
    """
    shift = least_deviations(by.shift_px, moves.to(by.shift_px.device), MIN_SHIFT_PX)
    common = by.gain.new_ones(by.gain.shape[1], 1, 1)
    gain = least_deviations(by.gain.log()[..., None], common, MIN_LOG_GAIN)
    return replace(by, shift_px=shift, gain=gain[..., 0].exp())


class Aligned(nn.Module):
    """Reconstruction by another method from aligned views, in the unit of (views / mm).

    The alignment is not differentiated. In training the corrected views of each case are computed
    once, see `CaseCache`.

    Args:
        method: name and options of the method.
        alternations, iterations: see `self_aligned`.

    Raises:
        LookupError: an unknown name.
        TypeError: an unknown option of the method.
    """

    def __init__(
        self, method: MethodPart, alternations: PositiveInt = 4, iterations: PositiveInt = 8
    ):
        super().__init__()
        self.method = build_method(method)
        self.options = {"alternations": alternations, "iterations": iterations}
        self._cases = CaseCache()

    def forward(self, views: Float[Tensor, "b 1 m v u"], A: Projector) -> Reconstruction:
        check_views(views, A.cameras)
        check_no_gradient("aligned", views)
        # sub-pixel alignment needs float32
        with torch.no_grad(), torch.autocast(views.device.type, enabled=False):
            corrected = self._recalled(views, A) if self.training else self._corrected(views, A)
        if not views.is_cuda:  # the check would synchronise
            warn_unless_aligned(corrected.alignment)
        return replace(self.method(corrected.views, A), alignment=corrected.alignment)

    def _corrected(self, views: Float[Tensor, "b 1 m v u"], A: Projector) -> CorrectedViews:
        return self_aligned(A, views, **self.options)

    def _recalled(self, views: Float[Tensor, "b 1 m v u"], A: Projector) -> CorrectedViews:
        """The corrected views of a batch, computed once for each case."""

        def made(samples: Sequence[int]) -> list[Tensor]:
            y, by = self._corrected(views[samples], A.of_samples(samples))
            return [y, *by.tensors()]

        y, *by = self._cases(made, A, self.options, views)
        return CorrectedViews(y, Alignment(*by))
