"""Alignment of measured with expected views: the shift and gain error of each camera.

A detector shifted by s pixels with gain g measures y(p) = g e(p + s) of the expected view e. Both
follow from least squares by Gauss-Newton steps (Lucas & Kanade, IJCAI 1981), with robust weights
for pixels that the expected view does not explain (Huber, Ann. Math. Stat. 35, 1964), and a prior
centred on an error-free camera.

Convention: shifts are those of `Misalignment.offset_px`: of the detector, along (u, v).
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from mvrecon.core.numbers import SIGMA_PER_MEDIAN, divided
from mvrecon.methods.classical.fdk import filter_rows, ramp_response
from mvrecon.methods.method import DEFAULT_PRIOR, Alignment, CameraPrior
from mvrecon.operators.operator import Symmetric


class Blur(Symmetric):
    """Gaussian blur along the axes of a tensor, with zero padding.

    Args:
        shape: shape of a volume (d, h, w), or of views (m, v, u).
        sigmas: standard deviation along each axis, in voxels or pixels; 0: none.
        device: device on which the operator computes.
    """

    def __init__(
        self, shape: Sequence[int], sigmas: Sequence[float], device: torch.device | str = "cpu"
    ):
        super().__init__(shape, device)
        self._bands = [
            _band(size, sigma, self.device) if sigma else None
            for size, sigma in zip(shape, sigmas, strict=True)
        ]

    def forward(self, x: Float[Tensor, "b c *n"]) -> Float[Tensor, "b c *n"]:
        for axis, band in enumerate(self._bands, start=2):
            if band is not None:
                x = (x.movedim(axis, -1) @ band.to(x)).movedim(-1, axis)
        return x.contiguous()


class RootRamp(Symmetric):
    """The square root of the windowed ramp filter along the rows of views.

    Args:
        shape: shape of the views (m, v, u).
        cutoff: fraction of the pixels' Nyquist frequency.
        device: device on which the operator computes.
    """

    def __init__(self, shape: Sequence[int], cutoff: float, device: torch.device):
        super().__init__(shape, device)
        self._response = ramp_response(shape[-1], "hann", cutoff).clamp_min(0).sqrt()

    def forward(self, x: Float[Tensor, "b c *n"]) -> Float[Tensor, "b c *n"]:
        return filter_rows(x, self._response)


def blurred(
    views: Float[Tensor, "b c m v u"], sigma_px: float, mask: Bool[Tensor, "m v u"] | None = None
) -> Float[Tensor, "b c m v u"]:
    """Blur views by a Gaussian, in their own unit, from the pixels inside the detector alone.

    Normalised convolution (Knutsson & Westin, Proc. CVPR 1993): the weights of the valid pixels sum
    to one; zero where there are none.

    Args:
        views: measured integrals.
        sigma_px: standard deviation along u and v, in pixels.
        mask: the valid pixels; None: all.
    """
    shape = views.shape[2:]
    blur = Blur(shape, (0.0, sigma_px, sigma_px), views.device)
    counts = views.new_ones(1, 1, *shape) if mask is None else mask[None, None].to(views)
    weight = blur(counts)
    total = blur(torch.where(counts > 0, views, 0.0))
    return divided(total, weight)


#: Blur weights up to this value are set to zero.
MIN_BLUR_WEIGHT = 1e-20


def _band(size: int, sigma: float, device: torch.device) -> Float[Tensor, "n n"]:
    """The Gaussian weights between the pixels of a row, symmetric as all rows share the sum of the
    unbounded one.
    """
    place = torch.arange(size, dtype=torch.float64, device=device)
    apart = (place[:, None] - place).abs()
    most = int(8 * sigma + 1)
    reach = torch.arange(-most, most + 1, dtype=torch.float64, device=device)
    weights = torch.exp(-((apart / sigma) ** 2) / 2) / torch.exp(-((reach / sigma) ** 2) / 2).sum()
    # far lower ones are denormal in float32, which slows a multiplication up to fifty times
    return torch.where(weights > MIN_BLUR_WEIGHT, weights, 0.0)


#: Pixels on each side used by `translated`, and the longest shift in pixels.
KERNEL_HALF_WIDTH = MAX_SHIFT_PX = 4


def translated(
    views: Float[Tensor, "b c m v u"], shift_px: Float[Tensor, "#b #m 2"]
) -> Float[Tensor, "b c m v u"]:
    """Shift detectors by up to `MAX_SHIFT_PX` pixels, y(p) = x(p + s), in the unit of the views;
    edge values are replicated.

    Lanczos interpolation (8 pixels) along columns and along rows.
    """
    along_u, along_v = (
        _interpolation(shift_px[..., axis].to(views.dtype), views.shape[size])[:, None]
        for axis, size in ((0, -1), (1, -2))
    )
    return along_v @ views @ along_u.mT


def _interpolation(shift: Float[Tensor, "#b #m"], count: int) -> Float[Tensor, "#b #m n n"]:
    """Interpolation weights of pixels at their positions plus a shift."""
    beyond = KERNEL_HALF_WIDTH + MAX_SHIFT_PX
    places = torch.arange(count, dtype=shift.dtype, device=shift.device)
    pixels = torch.arange(-beyond, count + beyond, device=shift.device)
    apart = places[:, None] + shift[..., None, None] - pixels
    kernel = (
        torch.sinc(apart)
        * torch.sinc(apart / KERNEL_HALF_WIDTH)
        * (apart.abs() < KERNEL_HALF_WIDTH)
    )
    edge = torch.eye(count, dtype=shift.dtype, device=shift.device)[pixels.clamp(0, count - 1)]
    return kernel @ edge / kernel.sum(dim=-1, keepdim=True)


#: Huber's threshold in standard deviations, reweighted fits.
HUBER_THRESHOLD, REWEIGHTED_FITS = 1.345, 3
#: Standard deviation in pixels of the blur before comparison.
BLUR_SIGMA_PX = 1.0
#: Rows and columns of a block of pixels with correlated errors of an expected view.
CORRELATED_PIXELS = 8
#: Relative to the greatest value: pixels below are background, residuals below are rounding.
MIN_CONTENT, MIN_RESIDUAL = 1e-3, 1e-6


def alignment(
    views: Float[Tensor, "b 1 m v u"],
    expected: Float[Tensor, "b 1 m v u"],
    weight: Float[Tensor, "#b 1 #m #v #u"] | None = None,
    start: Alignment | None = None,
    steps: int = 2,
    prior: CameraPrior = DEFAULT_PRIOR,
) -> Alignment:
    """Fit the shift in pixels and the gain of every view, such that the shifted and scaled expected
    view equals the measured one.

    Differentiable in both, at fixed final pixel weights. Standard errors are those of the fit
    alone: an expected view made from the measured ones shares their errors.

    Args:
        views: measured views.
        expected: expected views A x, in the same unit.
        weight: weight of each pixel, at least 0; by default 1.
        start: initial alignment; by default of error-free cameras.
        steps: Gauss-Newton steps.
        prior: standard deviations of the expected errors.

    Raises:
        ValueError: views of different shapes, or no step.
    """
    if views.shape != expected.shape or views.ndim != 5 or steps < 1:
        raise ValueError(
            f"expected measured and expected views of one shape [b 1 m v u] and at least one step, "
            f"got {tuple(views.shape)}, {tuple(expected.shape)} and {steps}"
        )
    one = start or Alignment.none(views)
    smooth = blurred(expected, BLUR_SIGMA_PX)
    peak = smooth.detach().abs().amax((1, 2, 3, 4), keepdim=True)
    unit = torch.where(peak > 0, peak, 1.0)  # nothing expected: the prior alone remains
    counts = (smooth.detach().abs() > MIN_CONTENT * peak) * (1 if weight is None else weight)
    fit = _ViewFit(
        _columns(smooth).div(unit[:, 0]),
        counts.to(views.dtype)[:, 0].flatten(2),
        torch.cat([views.new_full((2,), prior.shift_px), views.new_full((1,), prior.gain)]).pow(-2),
        math.prod(min(size, CORRELATED_PIXELS) for size in views.shape[-2:]),
    )
    for _ in range(steps):
        rest = (blurred(aligned(views, one), BLUR_SIGMA_PX) - smooth) / unit
        one = fit.step(rest[:, 0].flatten(2), one)
    return one


class _ViewFit(NamedTuple):
    """The least-squares fit of each view's own three parameters.

    Args:
        columns: derivatives by either shift, per pixel, and by the gain.
        weight: weight of each pixel.
        precision: precision of the prior, 1 / variance.
        correlated: pixels of a block with correlated errors.
    """

    columns: Float[Tensor, "b m n 3"]
    weight: Float[Tensor, "b m n"]
    precision: Float[Tensor, " 3"]
    correlated: int

    def step(self, rest: Float[Tensor, "b m n"], at: Alignment) -> Alignment:
        """One Gauss-Newton step, with weights from the remaining residual."""
        present = torch.cat([at.shift_px, (at.gain - 1)[..., None]], dim=-1)
        change = torch.zeros_like(present)
        inverse = torch.zeros_like(present[..., None])
        for _ in range(REWEIGHTED_FITS):
            left = (rest - (self.columns @ change[..., None])[..., 0]).detach()
            scale = self._scale(left)
            share = HUBER_THRESHOLD * scale / left.abs().clamp_min(MIN_RESIDUAL)
            weight = self.weight * share.clamp_max(1)
            weighted = self.columns * (weight / (self.correlated * scale**2))[..., None]
            # the prior keeps it regular, so no check has to synchronise
            inverse = torch.linalg.inv_ex(weighted.mT @ self.columns + self.precision.diag())[0]
            slope = (weighted.mT @ rest[..., None])[..., 0] - self.precision * present
            change = (inverse @ slope[..., None])[..., 0]
        error = inverse.diagonal(dim1=-2, dim2=-1).sqrt()
        shift = (at.shift_px + change[..., :2]).clamp(-MAX_SHIFT_PX, MAX_SHIFT_PX)
        gain = at.gain * (1 + change[..., 2].clamp(-0.5, 0.5))
        return Alignment(shift, gain, error[..., :2], error[..., 2])

    def _scale(self, left: Float[Tensor, "b m n"]) -> Float[Tensor, "b m 1"]:
        """Standard deviation of the residual, from the median over the valid pixels."""
        median = left.abs().masked_fill(self.weight == 0, torch.nan).nanmedian(-1, True).values
        return (SIGMA_PER_MEDIAN * median).nan_to_num(1.0).clamp_min(MIN_RESIDUAL)


def aligned(views: Float[Tensor, "b 1 m v u"], by: Alignment) -> Float[Tensor, "b 1 m v u"]:
    """Undo an alignment's errors in views, in their unit; differentiable in views and errors. A
    lost view (gain 0) stays unchanged.

    A view without negative values, such as counts, gets none: those of the interpolation are set to
    zero, and the view is scaled to the interpolation's sum.
    """
    gain = by.gain.where(by.gain != 0, 1)
    moved = translated(views, -by.shift_px)
    above, axes = moved.clamp_min(0), (3, 4)
    share = divided(moved.sum(axes, keepdim=True).clamp_min(0), above.sum(axes, keepdim=True))
    moved = torch.where(views.amin(axes, keepdim=True) < 0, moved, above * share)
    return moved / gain[:, None, :, None, None]


def _columns(smooth: Float[Tensor, "b 1 m v u"]) -> Float[Tensor, "b m n 3"]:
    """Derivatives by the two shifts (central differences of half a pixel) and by the gain."""
    halves = 0.5 * torch.eye(2, dtype=smooth.dtype, device=smooth.device)[:, None, None]
    ahead, behind = ([translated(smooth, side * half) for half in halves] for side in (1, -1))
    moved = [one - other for one, other in zip(ahead, behind, strict=True)]
    return torch.stack([*moved, smooth], dim=-1)[:, 0].flatten(2, 3)


#: Modes that move less than this part of the total are not shared by the cameras.
MIN_SHARED_MOVE = 1e-10
#: Iterations of reweighted least squares for the least absolute deviations.
LEAST_DEVIATION_FITS = 10


def least_deviations(
    values: Float[Tensor, "b m k"], modes: Float[Tensor, "m k q"], floor: float
) -> Float[Tensor, "b m k"]:
    """Subtract the combination of modes that leaves the least sum of lengths; in the values' unit.

    Args:
        values: values of each camera.
        modes: modes common to all cameras.
        floor: length below which values count as zero.
    """
    dtype, values, modes = values.dtype, values.double(), modes.double()
    rest, flat = values, modes.flatten(0, 1)
    unit = torch.eye(modes.shape[2], dtype=values.dtype, device=values.device)
    for _ in range(LEAST_DEVIATION_FITS):
        weight = (rest.square().sum(dim=-1, keepdim=True) + floor**2).rsqrt()
        weighted = (modes * weight[..., None]).flatten(1, 2).mT
        slope = weighted @ values.flatten(1)[..., None]
        normal = weighted @ flat
        total = normal.diagonal(dim1=-2, dim2=-1).sum(dim=-1)[..., None, None]
        # too little to affect other than zero modes; a pseudo-inverse would synchronise
        damping = (MIN_SHARED_MOVE * total + torch.finfo(values.dtype).eps) * unit
        shared = flat @ torch.linalg.inv_ex(normal + damping)[0] @ slope
        rest = values - shared.view_as(values)
    return rest.to(dtype)
