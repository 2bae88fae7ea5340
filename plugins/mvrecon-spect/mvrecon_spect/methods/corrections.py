"""Corrections for scatter, uniformity, dead time and decay, and the post-filter.

    y = w * A x + r

The scatter r is an expectation in counts, the `background` of a reconstruction; uniformity, dead
time and decay are factors w of the operator, see `corrected`. Counts are not modified, so they
remain Poisson distributed. A scatter estimate from measured windows already contains the factors.
"""

import math
from collections.abc import Callable, Sequence
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from mvrecon.data.acquisition.detector import blurred, gaussian_weights
from mvrecon.geometry.cameras.camera import Cameras
from mvrecon.geometry.grid import Grid
from mvrecon.operators.operator import LinearOperator, Scaled
from mvrecon_spect.methods.counts import check_counts

#: Half-lives between a view and the reference time, at most: a billionth of the activity is left.
MAX_HALF_LIVES = 30


def dual_energy_window(
    lower: Float[Tensor, "b 1 m v u"],
    k: float = 0.5,
    cameras: Cameras | None = None,
    smoothing_mm: float = 0.0,
) -> Float[Tensor, "b 1 m v u"]:
    """Scatter in the main energy window as a multiple of the counts of one window below it, r = k
    C_s, in counts.

    Jaszczak, Greer, Floyd, Harris, Coleman, J. Nucl. Med. 25 (1984) 893: k = 0.5 for windows of 92
    to 125 and 127 to 153 keV. For other windows, determine k from a measured or simulated phantom.

    Args:
        lower: counts of the lower window.
        k: see above, dimensionless.
        cameras: define the pixel size in mm for smoothing.
        smoothing_mm: FWHM of the Gaussian that smooths the estimate.

    Raises:
        ValueError: k or counts are negative or not finite, or smoothing without cameras.
    """
    if not 0 <= k < math.inf:
        raise ValueError(f"Expected a finite k of at least 0, got {k}")
    check_counts(lower)
    return k * _smooth(lower, smoothing_mm, cameras)


def triple_energy_window(
    lower: Float[Tensor, "b 1 m v u"],
    upper: Float[Tensor, "b 1 m v u"] | None,
    widths_kev: Sequence[float],
    cameras: Cameras | None = None,
    smoothing_mm: float = 0.0,
) -> Float[Tensor, "b 1 m v u"]:
    """Scatter in the main energy window, the area of a trapezium between the adjacent windows: r =
    (C_l / w_l + C_u / w_u) w_m / 2, in counts.

    Ogawa, Harata, Ichihara, Kubo, Hashimoto, IEEE Trans. Med. Imaging 10 (1991) 408.

    Args:
        lower: counts of the adjacent lower window.
        upper: counts of the adjacent upper window; None: zero, as above a single photopeak.
        widths_kev: widths of the lower, main and upper windows.
        cameras: define the pixel size in mm for smoothing.
        smoothing_mm: FWHM of the Gaussian that smooths the estimate.

    Raises:
        ValueError: widths that are not three positive numbers, counts that are negative or not
            finite, views of different shapes, or smoothing without cameras.
    """
    if len(widths_kev) != 3 or not all(0 < w < math.inf for w in widths_kev):
        raise ValueError(
            f"Expected three positive window widths in keV (lower, main, upper), got "
            f"{list(widths_kev)}"
        )
    upper = torch.zeros_like(lower) if upper is None else upper
    if upper.shape != lower.shape:
        raise ValueError(
            f"Expected windows of one shape, got {tuple(lower.shape)} and {tuple(upper.shape)}"
        )
    for counts in (lower, upper):
        check_counts(counts)
    low, main, high = widths_kev
    scatter = (lower / low + upper / high) * (main / 2)
    return _smooth(scatter, smoothing_mm, cameras)


def blurred_share(
    counts: Float[Tensor, "b 1 m v u"],
    share: float,
    fwhm_mm: float,
    cameras: Cameras,
    iterations: int = 10,
) -> Float[Tensor, "b 1 m v u"]:
    """Scatter as a fraction of blurred primary counts, r = share B P with P + r = counts, in
    counts.

    Iterates P = counts - share B P from P = counts / (1 + share), with a non-negativity constraint;
    each iteration reduces the error by `share`. Estimates the scatter that `scatter` and
    `scatter_mm` of an acquisition add.

    Args:
        counts: primaries and scatter.
        share: scatter-to-primary ratio, below 1.
        fwhm_mm: FWHM of the Gaussian B on the detector.
        cameras: define the pixel size in mm.
        iterations: number of iterations of the primaries.

    Raises:
        ValueError: a share outside [0, 1), or counts that are negative or not finite.
    """
    if not 0 <= share < 1:
        raise ValueError(f"Expected a share of scatter in [0, 1), got {share}")
    check_counts(counts)
    primary = counts / (1 + share)
    for _ in range(iterations):
        primary = (counts - share * _smooth(primary, fwhm_mm, cameras)).clamp_min(0)
    return share * _smooth(primary, fwhm_mm, cameras)


def given_scatter(
    shape: Float[Tensor, "b 1 m v u"], counts: Float[Tensor, "b 1 m v u"], fraction: float
) -> Float[Tensor, "b 1 m v u"]:
    """Scatter from a given map, such as a Monte Carlo simulation, scaled to a fraction of the
    counts: r = fraction sum(counts) shape / sum(shape) for each case, in counts.

    A map in counts can be used directly as `background`.

    Args:
        shape: the map, in any unit.
        counts: primaries and scatter of the main window.
        fraction: scatter fraction of the total counts.

    Raises:
        ValueError: a fraction outside [0, 1), a map whose shape is not that of the counts, a zero
            map, or values that are negative or not finite.
    """
    if not 0 <= fraction < 1:
        raise ValueError(f"Expected a fraction of scatter in [0, 1), got {fraction}")
    if shape.shape != counts.shape:
        raise ValueError(
            f"Expected a map of the counts' shape {tuple(counts.shape)}, got {tuple(shape.shape)}"
        )
    check_counts(shape, "a map of scatter")
    check_counts(counts)
    total = shape.double().sum(dim=(1, 2, 3, 4), keepdim=True)
    if not (total > 0).all():
        raise ValueError("Expected a map with scatter in every case, got zeros alone")
    level = fraction * counts.double().sum(dim=(1, 2, 3, 4), keepdim=True) / total
    return (level * shape).to(counts)


Read = Callable[..., Float[Tensor, "1 1 m v u"]]


def given(
    counts: Float[Tensor, "1 1 m v u"],
    read: Read,
    cameras: Cameras,
    path: str | Path,
    fraction: float | None = None,
) -> Float[Tensor, "1 1 m v u"]:
    """Scatter from a map in a file of views, in counts; scaled by `given_scatter` if there is a
    fraction.

    Args:
        counts: measured counts.
        read: `read(path)` returns the counts in a file of views, scaled to the duration of the
            measured ones; `read(path, relative=True)` its values, also of an unknown dose;
            `read(path, widths_kev=(its own, that of the counts))` those of an energy window.
        cameras: cameras of the counts.
        path: path of the map.
        fraction: scatter fraction of the total counts; None: the map is in counts.

    Raises:
        ValueError: values that are negative or not finite; see `given_scatter`.
    """
    scatter = read(path, relative=fraction is not None)
    check_counts(scatter, "a map of scatter")
    return scatter if fraction is None else given_scatter(scatter, counts, fraction)


def dew(
    counts: Float[Tensor, "1 1 m v u"],
    read: Read,
    cameras: Cameras,
    lower: str | Path,
    k: float = 0.5,
    smoothing_mm: float = 0.0,
) -> Float[Tensor, "1 1 m v u"]:
    """Scatter by `dual_energy_window` from the file of views of the lower window, in counts.

    Args:
        counts, read, cameras: see `given`.
        lower: path of the window's counts.
        k, smoothing_mm: see `dual_energy_window`.

    Raises:
        ValueError: counts of an unknown dose; see `dual_energy_window`.
    """
    return dual_energy_window(read(lower, widths_kev=(None, None)), k, cameras, smoothing_mm)


def tew(
    counts: Float[Tensor, "1 1 m v u"],
    read: Read,
    cameras: Cameras,
    lower: str | Path,
    widths_kev: Sequence[float],
    upper: str | Path | None = None,
    smoothing_mm: float = 0.0,
) -> Float[Tensor, "1 1 m v u"]:
    """Scatter by `triple_energy_window` from files of views of the adjacent windows, in counts.

    Args:
        counts, read, cameras: see `given`.
        lower, upper: paths of the windows' counts; upper defaults to zero counts.
        widths_kev, smoothing_mm: see `triple_energy_window`.

    Raises:
        ValueError: counts of an unknown dose; see `triple_energy_window`.
    """
    if len(widths_kev) != 3:
        raise ValueError(f"Expected three window widths in keV, got {list(widths_kev)}")
    low, main, high = widths_kev
    below = read(lower, widths_kev=(low, main))
    above = None if upper is None else read(upper, widths_kev=(high, main))
    return triple_energy_window(below, above, widths_kev, cameras, smoothing_mm)


def uniformity_factors(
    flood: Float[Tensor, "m v u"],
    expected: Float[Tensor, "m v u"] | None = None,
    cameras: Cameras | None = None,
    smoothing_mm: float = 0.0,
) -> Float[Tensor, "m v u"]:
    """Relative sensitivity of each pixel from a flood measurement: flood / expected, normalised to
    mean one over the live pixels of each view; dimensionless, float64.

    A flood of F counts per pixel results in a relative noise of F^(-1/2) of the factors: NEMA NU 1
    requires 10,000 counts in a central pixel. Factors of zero are dead pixels, whose counts must be
    set to zero, `counts * (factors > 0)`.

    Args:
        flood: counts of a uniform source.
        expected: expected counts of an ideal detector, in any unit; None: uniform in each view, as
            in an intrinsic measurement.
        cameras: define the pixel size in mm for smoothing.
        smoothing_mm: FWHM of the Gaussian that smooths flood and expectation.

    Raises:
        ValueError: counts that are negative or not finite, a view without counts, an expectation of
            the wrong shape or without positive values where the flood has counts, or smoothing
            without cameras.
    """
    expected = torch.ones_like(flood) if expected is None else expected
    if expected.shape != flood.shape:
        raise ValueError(
            f"Expected a flood and its expectation of one shape, got {tuple(flood.shape)} and "
            f"{tuple(expected.shape)}"
        )
    check_counts(flood, "a flood's counts")
    check_counts(expected, "a flood's expected counts")
    if not flood.flatten(1).any(dim=1).all() or ((expected == 0) & (flood > 0)).any():
        raise ValueError(
            "Expected a flood with counts in every view, and in no pixel where none are expected"
        )
    live = flood > 0  # a dead pixel is no sample, neither of its neighbours nor of the mean
    measured, ideal = (
        live * _smooth((live * values.double())[None, None], smoothing_mm, cameras)[0, 0]
        for values in (flood, expected)
    )
    level = measured.sum(dim=(1, 2), keepdim=True) / ideal.sum(dim=(1, 2), keepdim=True)
    return torch.where(live, measured / (level * ideal).clamp_min(1e-300), 0)


def live_factors(
    rates_per_s: Sequence[float], dead_time_s: float, paralysable: bool = False
) -> Float[Tensor, " m"]:
    """Live-time fraction of each view, m / n, dimensionless, in float64.

    With n events, m counts and the dead time tau,

        m = n / (1 + n tau)      non-paralysable: m / n = 1 - m tau
        m = n exp(-n tau)        paralysable: n tau is the lower of the two solutions

    Evans, The Atomic Nucleus (1955), chapter 28; for scintillation cameras Adams, Hine, Zimmerman,
    J. Nucl. Med. 19 (1978) 538. The count rate of a paralysable detector is ambiguous: the true
    rate must be known to be below 1 / tau.

    Args:
        rates_per_s: m, counts per second registered in each view, including all energies and all
            pixels that share the electronics, not only those of an energy window.
        dead_time_s: dead time tau.
        paralysable: use the paralysable model.

    Raises:
        ValueError: rates or a dead time that are negative or not finite, or an impossible rate: m
            tau of 1 or more, or above 1 / e for the paralysable model.
    """
    rates = torch.as_tensor(rates_per_s, dtype=torch.float64)
    check_counts(rates, "rates")
    load = rates * dead_time_s
    fits, domain = (load <= 1 / math.e, "<= 1 / e") if paralysable else (load < 1, "< 1")
    if not 0 <= dead_time_s < math.inf or not fits.all():
        raise ValueError(
            f"Expected a dead time tau of at least 0 s and rates m with m tau {domain}, got tau "
            f"{dead_time_s} s and m up to {rates.max().item():.4g} per s"
        )
    if not paralysable:
        return 1 - load
    low, high = torch.zeros_like(load), torch.ones_like(load)
    for _ in range(60):  # bisection of n tau exp(-n tau) = m tau, which increases up to n tau = 1
        middle = (low + high) / 2
        below = middle * torch.exp(-middle) < load
        low, high = torch.where(below, middle, low), torch.where(below, high, middle)
    return torch.exp(-low)


def decay_factors(
    start_s: Sequence[float],
    duration_s: Sequence[float],
    half_life_s: float,
    reference_s: float = 0.0,
) -> Float[Tensor, " m"]:
    """Mean activity during each view relative to that at the reference time, dimensionless: exp(-k
    (t - t_0)) (1 - exp(-k T)) / (k T) with k = ln 2 / half-life.

    Args:
        start_s: start time t of each view in seconds.
        duration_s: duration T of each view in seconds.
        half_life_s: half-life of the isotope; 99mTc: 21624 s.
        reference_s: time t_0 of the reconstructed activity, such as that of the injection.

    Raises:
        ValueError: a half-life or duration that is not positive and finite, lists of different
            lengths, or a view more than `MAX_HALF_LIVES` from the reference, as of another clock.
    """
    finite = all(0 < time < math.inf for time in (half_life_s, *duration_s))
    if not finite or not len(start_s) == len(duration_s) > 0:
        raise ValueError(
            f"Expected a positive half-life, and for each view a start and a positive duration, "
            f"finite and in s, got {half_life_s}, {len(start_s)} starts and durations "
            f"{list(duration_s)}"
        )
    start, duration = (torch.tensor(list(t), dtype=torch.float64) for t in (start_s, duration_s))
    if not ((start - reference_s).abs() <= MAX_HALF_LIVES * half_life_s).all():
        raise ValueError(
            f"Expected starts within {MAX_HALF_LIVES} half-lives of {half_life_s:g} s from the "
            f"reference, {reference_s:g} s, on one clock, got {start.min():g} to {start.max():g} s"
        )
    rate = math.log(2) / half_life_s
    share = -torch.expm1(-rate * duration) / (rate * duration)
    return torch.exp(-rate * (start - reference_s)) * share


def corrected(A: LinearOperator, *factors: Float[Tensor, "m *pixels"]) -> Scaled:
    """Operator of counts with all given factors: per view [m], such as decay and live time, or per
    pixel [m v u], such as uniformity.

    Convention: factors are part of the operator and never applied to the counts, which would no
    longer be Poisson distributed.

    Args:
        A: operator of ideal detectors and of the activity at the reference time.
        factors: factors to multiply.

    Raises:
        ValueError: factors that are neither per view nor per pixel, or that are negative or not
            finite.
    """
    weight = torch.ones(A.range_shape[0], 1, 1, dtype=torch.float64)
    for factor in factors:
        if factor.shape not in (A.range_shape[:1], A.range_shape):
            raise ValueError(
                f"Expected a factor for each of {A.range_shape[0]} views or of {A.range_shape} "
                f"pixels, got {tuple(factor.shape)}"
            )
        check_counts(factor, "factors")
        weight = weight * factor.double().reshape(*factor.shape, *(1,) * (3 - factor.ndim))
    return Scaled(A, pixels=weight)


def post_filtered(
    volume: Float[Tensor, "b c d h w"], grid: Grid, fwhm_mm: float
) -> Float[Tensor, "b c d h w"]:
    """Filter a volume with a Gaussian of the given FWHM in mm along each of its axes.

    Each weight is the Gaussian's integral over a voxel. At the grid's boundary the weights are
    normalised over the voxels inside the grid: a uniform volume does not change.

    Raises:
        ValueError: a width that is negative or not finite, or a volume whose shape is not that of
            the grid.
    """
    if not 0 <= fwhm_mm < math.inf:
        raise ValueError(f"Expected a finite FWHM of at least 0 mm, got {fwhm_mm}")
    if volume.shape[-3:] != grid.shape:
        raise ValueError(
            f"Expected a volume of the grid's {grid.shape} voxels, got {tuple(volume.shape)}"
        )
    if not fwhm_mm:
        return volume
    for dim, pitch in zip((-1, -2, -3), grid.spacing, strict=True):
        step = torch.tensor([pitch], dtype=torch.float64)
        along = gaussian_weights(step, volume.shape[dim], fwhm_mm)[0].to(volume)
        volume = (volume.transpose(dim, -1) @ along.mT).transpose(dim, -1)
    return volume


def _smooth(
    views: Float[Tensor, "b 1 m v u"], fwhm_mm: float, cameras: Cameras | None
) -> Float[Tensor, "b 1 m v u"]:
    if not 0 <= fwhm_mm < math.inf:
        raise ValueError(f"Expected a finite FWHM of at least 0 mm, got {fwhm_mm}")
    if not fwhm_mm:
        return views
    if cameras is None:
        raise ValueError(f"Expected cameras for a smoothing of {fwhm_mm} mm, got None")
    return torch.stack([blurred(one, fwhm_mm, cameras) for one in views])
