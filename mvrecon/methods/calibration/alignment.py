"""Alignment of measured views with expected ones: what shift and what gain each camera has wrong.

A detector that is shifted by s pixels, with a gain g, measures y(p) = g e(p + s) of the view e that
it should see. Least squares by Gauss-Newton steps finds both (Lucas & Kanade, IJCAI 1981), with
weights that keep out what the expected view does not explain (Huber, Ann. Math. Stat. 35, 1964),
and a prior towards a camera as it should be.

Convention: shifts are those of `Misalignment.offset_px`: of the detector, along (u, v).
"""

from collections.abc import Sequence
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from mvrecon.core.numbers import divided
from mvrecon.methods.method import USUAL, Alignment, Prior
from mvrecon.operators.operator import LinearOperator


class Blur(LinearOperator):
    """Gaussian blur along the axes of a tensor, symmetric; outside of the tensor is zero.

    Args:
        shape: of a volume (d, h, w), or of views (m, v, u).
        sigmas: standard deviation along each axis, in voxels or pixels; 0: none.
        device: where the operator computes.
    """

    def __init__(
        self,
        shape: Sequence[int],
        sigmas: Sequence[float],
        device: torch.device | str = "cpu",
    ):
        self.domain_shape = self.range_shape = tuple(shape)
        self._bands = [
            _band(size, sigma, torch.device(device)) if sigma else None
            for size, sigma in zip(shape, sigmas, strict=True)
        ]
        self._device = torch.device(device)

    @property
    def device(self) -> torch.device:
        return self._device

    def forward(self, x: Float[Tensor, "b c *n"]) -> Float[Tensor, "b c *n"]:
        for axis, band in enumerate(self._bands, start=2):
            if band is not None:
                x = (x.movedim(axis, -1) @ band.to(x)).movedim(-1, axis)
        return x.contiguous()

    def adjoint(self, y: Float[Tensor, "b c *n"]) -> Float[Tensor, "b c *n"]:
        return self.forward(y)


def blurred(
    views: Float[Tensor, "b c m v u"], sigma_px: float, mask: Bool[Tensor, "m v u"] | None = None
) -> Float[Tensor, "b c m v u"]:
    """Views blurred by a Gaussian in their own unit, from the pixels inside the detector alone.

    Normalised convolution (Knutsson & Westin, Proc. CVPR 1993): the weights of the pixels that
    count add up to one; zero where there are none.

    Args:
        views: measured integrals.
        sigma_px: standard deviation along u and v, in pixels.
        mask: the pixels that count; None: all.
    """
    shape = views.shape[2:]
    blur = Blur(shape, (0.0, sigma_px, sigma_px), views.device)
    counts = views.new_ones(1, 1, *shape) if mask is None else mask[None, None].to(views)
    weight = blur(counts)
    total = blur(torch.where(counts > 0, views, 0.0))
    return divided(total, weight)


def _band(size: int, sigma: float, device: torch.device) -> Float[Tensor, "n n"]:
    """The weights of a Gaussian between the places of a row; the same whichever way they are read,
    which needs the sum of the unbounded row for all of them.
    """
    place = torch.arange(size, dtype=torch.float64, device=device)
    apart = (place[:, None] - place).abs()
    most = int(8 * sigma + 1)
    reach = torch.arange(-most, most + 1, dtype=torch.float64, device=device)
    return torch.exp(-((apart / sigma) ** 2) / 2) / torch.exp(-((reach / sigma) ** 2) / 2).sum()


#: Pixels of each side that count in `translated`, and the longest shift in pixels.
REACH = LONGEST = 4


def translated(
    views: Float[Tensor, "b c m v u"], shift_px: Float[Tensor, "#b #m 2"]
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


def _interpolation(shift: Float[Tensor, "#b #m"], count: int) -> Float[Tensor, "#b #m n n"]:
    """Weights of pixels for values at their places plus a shift."""
    beyond = REACH + LONGEST
    places = torch.arange(count, dtype=shift.dtype, device=shift.device)
    pixels = torch.arange(-beyond, count + beyond, device=shift.device)
    apart = places[:, None] + shift[..., None, None] - pixels
    kernel = torch.sinc(apart) * torch.sinc(apart / REACH) * (apart.abs() < REACH)
    edge = torch.eye(count, dtype=shift.dtype, device=shift.device)[pixels.clamp(0, count - 1)]
    return kernel @ edge / kernel.sum(dim=-1, keepdim=True)


#: Huber's threshold in standard deviations, the factor from a median to these, fits by weights.
HUBER, DEVIATION, REWEIGHTED = 1.345, 1.4826, 3
#: Standard deviation in pixels of the blur under which views are compared.
BLUR = 1.0
#: Pixels among which errors of an expected view are alike.
ALIKE = 64.0
#: Of the greatest value: pixels below see no object; scales of residuals below are rounding.
EMPTY, ROUNDING = 1e-3, 1e-6


class CorrectedViews(NamedTuple):
    """Views after a correction.

    Args:
        views: in the unit of the measured ones.
        alignment: what was wrong with the cameras, where the correction tells.
    """

    views: Float[Tensor, "b 1 m v u"]
    alignment: Alignment | None = None


def alignment(
    views: Float[Tensor, "b 1 m v u"],
    expected: Float[Tensor, "b 1 m v u"],
    weight: Float[Tensor, "#b 1 #m #v #u"] | None = None,
    start: Alignment | None = None,
    steps: int = 2,
    prior: Prior = USUAL,
) -> Alignment:
    """Least-squares shift in pixels and gain of every view, such that the expected view, moved and
    multiplied, is the measured one.

    Differentiable in both, for the weights that pixels then have. The errors are those of the fit
    alone: an expected view that was made from the measured ones has part of their errors itself.

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
    smooth = blurred(expected, BLUR)
    peak = smooth.detach().abs().amax((1, 2, 3, 4), keepdim=True)
    unit = torch.where(peak > 0, peak, 1.0)  # no object is expected: then nothing is known
    counts = (smooth.detach().abs() > EMPTY * peak) * (1 if weight is None else weight)
    fit = _Fit(
        _columns(smooth).div(unit[:, 0]),
        counts.to(views.dtype)[:, 0].flatten(2),
        torch.cat([views.new_full((2,), prior.shift_px), views.new_full((1,), prior.gain)]).pow(-2),
    )
    for _ in range(steps):
        rest = (blurred(aligned(views, one), BLUR) - smooth) / unit
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
            # the prior keeps it from being singular, so that nobody has to wait for a check
            inverse = torch.linalg.inv_ex(weighted.mT @ self.columns + self.precision.diag())[0]
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


def aligned(views: Float[Tensor, "b 1 m v u"], by: Alignment) -> Float[Tensor, "b 1 m v u"]:
    """Views as cameras without these errors would have measured them, in their unit; differentiable
    in views and errors. A lost view, of gain zero, stays as it is.
    """
    gain = by.gain.where(by.gain != 0, 1)
    return translated(views, -by.shift_px) / gain[:, None, :, None, None]


def _columns(smooth: Float[Tensor, "b 1 m v u"]) -> Float[Tensor, "b m n 3"]:
    """Derivatives by the two shifts (difference quotients of half a pixel to each side) and by the
    gain.
    """
    halves = 0.5 * torch.eye(2, dtype=smooth.dtype, device=smooth.device)[:, None, None]
    ahead, behind = ([translated(smooth, side * half) for half in halves] for side in (1, -1))
    moved = [one - other for one, other in zip(ahead, behind, strict=True)]
    return torch.stack([*moved, smooth], dim=-1)[:, 0].flatten(2, 3)
