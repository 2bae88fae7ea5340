"""Alignment of measured views with expected ones: what shift and what gain each camera has wrong.

A detector that is shifted by s pixels, with a gain g, measures y(p) = g e(p + s) of the view e that
it should see. Least squares by Gauss-Newton steps finds both (Lucas & Kanade, IJCAI 1981), with
weights that keep out what the expected view does not explain (Huber, Ann. Math. Stat. 35, 1964),
and a prior towards a camera as it should be.

Convention: shifts are those of `Misalignment.offset_px`: of the detector, along (u, v).
"""

from dataclasses import dataclass
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

#: Pixels of each side that count in `translated`, and the longest shift in pixels.
REACH = LONGEST = 4
#: Blur of both views before they are compared, standard deviation in pixels.
BLUR = 1.0
#: Huber's threshold in standard deviations, the factor from a median to these, fits by weights.
HUBER, DEVIATION, REWEIGHTED = 1.345, 1.4826, 3
#: Pixels among which errors of an expected view are alike.
ALIKE = 64.0
#: Of the greatest value: pixels below see no object; scales of residuals below are rounding.
EMPTY, ROUNDING = 1e-3, 1e-6


class Prior(NamedTuple):
    """Standard deviations of a camera's errors that are to be expected.

    Args:
        shift_px: along each axis, in pixels.
        gain: relative.
    """

    shift_px: float = 1.0
    gain: float = 0.05


@dataclass(frozen=True, eq=False)
class Alignment:
    """What is wrong with each view, and how well it is known.

    Args:
        shift_px: of the detector along its columns' and its rows' direction (u, v), in pixels.
        gain: factor of the view's values.
        shift_error: standard error of the shifts, in pixels.
        gain_error: standard error of the gains.
    """

    shift_px: Float[Tensor, "b m 2"]
    gain: Float[Tensor, "b m"]
    shift_error: Float[Tensor, "b m 2"]
    gain_error: Float[Tensor, "b m"]

    @classmethod
    def none(cls, views: Float[Tensor, "b 1 m v u"]) -> "Alignment":
        """Cameras as they should be, without an error."""
        zero = views.new_zeros(len(views), views.shape[2])
        pair = zero[..., None].expand(-1, -1, 2)
        return cls(pair, zero + 1, pair, zero)

    def deviation(self, prior: Prior = Prior()) -> Float[Tensor, "b m"]:
        """How wrong each camera is, without a unit: shift and gain relative to what is to be
        expected.
        """
        shift = (self.shift_px / prior.shift_px).square().sum(dim=-1)
        return (shift + ((self.gain - 1) / prior.gain).square()).sqrt()


def alignment(
    views: Float[Tensor, "b 1 m v u"],
    expected: Float[Tensor, "b 1 m v u"],
    weight: Float[Tensor, "#b 1 #m #v #u"] | None = None,
    start: Alignment | None = None,
    steps: int = 2,
    prior: Prior = Prior(),
) -> Alignment:
    """Least-squares shift in pixels and gain of every view, such that the expected view, moved and
    multiplied, is the measured one.

    Differentiable in both. The errors are those of the fit alone: an expected view that was made
    from the measured ones has part of their errors itself.

    Args:
        views: measured.
        expected: A x, in the same unit.
        weight: of pixels, at least 0; by default all count.
        start: where Gauss-Newton begins; by default at cameras as they should be.
        steps: of Gauss-Newton.
        prior: of the errors.

    Raises:
        ValueError: views of different shapes, or no step.
    """
    if views.shape != expected.shape or views.ndim != 5 or steps < 1:
        raise ValueError(
            f"expected measured and expected views of one shape [b 1 m v u] and at least one step, "
            f"got {tuple(views.shape)}, {tuple(expected.shape)} and {steps}"
        )
    one = start or Alignment.none(views)
    smooth = blurred(expected)
    peak = smooth.detach().abs().amax((1, 2, 3, 4), keepdim=True)
    tiny = torch.finfo(views.dtype).tiny
    counts = (smooth.detach().abs() > EMPTY * peak) * (1 if weight is None else weight)
    fit = _Fit(
        _columns(smooth).div(peak.clamp_min(tiny)[:, 0]),
        counts.to(views.dtype)[:, 0].flatten(2),
        views.new_tensor([prior.shift_px, prior.shift_px, prior.gain]).pow(-2),
    )
    for _ in range(steps):
        rest = (blurred(aligned(views, one)) - smooth) / peak.clamp_min(tiny)
        one = fit.step(rest[:, 0].flatten(2), one)
    return one


class _Fit(NamedTuple):
    """Least squares of every view by its own three numbers.

    Args:
        columns: what a pixel more of either shift, and a gain of one more, would add.
        weight: of pixels.
        precision: of the prior, 1 / variance.
    """

    columns: Float[Tensor, "b m n 3"]
    weight: Float[Tensor, "b m n"]
    precision: Float[Tensor, " 3"]

    def step(self, rest: Float[Tensor, "b m n"], at: Alignment) -> Alignment:
        """One Gauss-Newton step, reweighted by what it leaves."""
        present = torch.cat([at.shift_px, (at.gain - 1)[..., None]], dim=-1)
        change = torch.zeros_like(present)
        inverse = torch.zeros_like(present[..., None])
        for _ in range(REWEIGHTED):
            left = (rest - (self.columns @ change[..., None])[..., 0]).detach()
            scale = self._scale(left)
            weight = self.weight * (HUBER * scale / left.abs().clamp_min(ROUNDING)).clamp_max(1)
            weighted = self.columns * (weight / (ALIKE * scale**2))[..., None]
            inverse = torch.linalg.inv(weighted.mT @ self.columns + self.precision.diag())
            slope = (weighted.mT @ rest[..., None])[..., 0] - self.precision * present
            change = (inverse @ slope[..., None])[..., 0]
        error = inverse.diagonal(dim1=-2, dim2=-1).sqrt()
        shift = (at.shift_px + change[..., :2]).clamp(-LONGEST, LONGEST)
        gain = at.gain * (1 + change[..., 2].clamp(-0.5, 0.5))
        return Alignment(shift, gain, error[..., :2], error[..., 2])

    def _scale(self, left: Float[Tensor, "b m n"]) -> Float[Tensor, "b m 1"]:
        """Standard deviation of what is left, from the median over the pixels that count."""
        median = left.abs().masked_fill(self.weight == 0, torch.nan).nanmedian(-1, True).values
        return (DEVIATION * median).nan_to_num(1.0).clamp_min(ROUNDING)


def aligned(
    views: Float[Tensor, "b 1 m v u"], by: Alignment
) -> Float[Tensor, "b 1 m v u"]:
    """Views as cameras without these errors would have measured them, in their unit; differentiable
    in views and errors.
    """
    return translated(views, -by.shift_px) / by.gain[:, None, :, None, None]


def translated(
    views: Float[Tensor, "b c m v u"], shift_px: Float[Tensor, "b m 2"]
) -> Float[Tensor, "b c m v u"]:
    """Views as detectors shifted by up to `LONGEST` pixels measure them, y(p) = x(p + s), in their
    unit; beyond the edge the edge's values go on.

    By a windowed sinc along columns and along rows (Lanczos, 8 pixels).
    """
    along_u, along_v = (
        _interpolation(shift_px[..., axis].to(views.dtype), views.shape[size])[:, None]
        for axis, size in ((0, -1), (1, -2))
    )
    return along_v @ views @ along_u.mT


def blurred(views: Float[Tensor, "b c m v u"], sigma: float = BLUR) -> Float[Tensor, "b c m v u"]:
    """Views after a Gaussian of a standard deviation in pixels, in their unit."""
    rows, columns = (_gaussian(views, size, sigma) for size in views.shape[-2:])
    return rows @ views @ columns.mT


def _columns(smooth: Float[Tensor, "b 1 m v u"]) -> Float[Tensor, "b m n 3"]:
    """Derivatives by the two shifts (difference quotients of half a pixel to each side) and by the
    gain.
    """
    halves = 0.5 * torch.eye(2).to(smooth)
    ahead, behind = (
        [translated(smooth, side * half.expand(*smooth.shape[::2][:2], 2)) for half in halves]
        for side in (1, -1)
    )
    moved = [one - other for one, other in zip(ahead, behind, strict=True)]
    return torch.stack([*moved, smooth], dim=-1)[:, 0].flatten(2, 3)


def _interpolation(shift: Float[Tensor, "b m"], count: int) -> Float[Tensor, "b m n n"]:
    """Weights of pixels for values at their places plus a shift."""
    beyond = REACH + LONGEST
    places = torch.arange(count, dtype=shift.dtype, device=shift.device)
    pixels = torch.arange(-beyond, count + beyond, device=shift.device)
    apart = places[:, None] + shift[..., None, None] - pixels
    kernel = torch.sinc(apart) * torch.sinc(apart / REACH) * (apart.abs() < REACH)
    edge = torch.eye(count, dtype=shift.dtype, device=shift.device)[pixels.clamp(0, count - 1)]
    return kernel @ edge / kernel.sum(dim=-1, keepdim=True)


def _gaussian(views: Tensor, count: int, sigma: float) -> Float[Tensor, "n n"]:
    places = torch.arange(count, dtype=views.dtype, device=views.device)
    kernel = torch.exp(-0.5 * ((places[:, None] - places) / sigma).square())
    return kernel / kernel.sum(dim=-1, keepdim=True)
