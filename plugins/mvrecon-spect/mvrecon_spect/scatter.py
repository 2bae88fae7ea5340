"""Scattered counts r in measured views: from two energy windows beside the main one, or as a
share of blurred primaries. Reconstructors take r as `background`, and the views unchanged, since
counts less r are no longer Poisson numbers.
"""

import math
from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from mvrecon.data.acquisition.detector import blurred
from mvrecon.geometry.cameras.camera import Cameras


def triple_energy_window(
    lower: Float[Tensor, "b 1 m v u"],
    upper: Float[Tensor, "b 1 m v u"] | None,
    widths_kev: Sequence[float],
    cameras: Cameras | None = None,
    smoothing_mm: float = 0.0,
) -> Float[Tensor, "b 1 m v u"]:
    """Scatter in the main energy window, the area of a trapezium between its neighbours: r = (C_l /
    w_l + C_u / w_u) w_m / 2, in counts.

    Ogawa, Harata, Ichihara, Kubo, Hashimoto, IEEE Trans. Med. Imaging 10 (1991) 408.

    Args:
        lower: counts of the window just below.
        upper: counts of the window just above; None: zero, as behind a single photon peak.
        widths_kev: of the lower, main and upper windows.
        cameras: that the pixels in mm belong to; for smoothing.
        smoothing_mm: of the estimate, full width at half maximum of a Gaussian.

    Raises:
        ValueError: widths that are not three positive numbers, counts that are negative or not
            finite, views of two shapes, or a smoothing without cameras.
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
    """Scatter as a share of blurred primaries, r = share B P with P + r = counts, in counts.

    P = counts - share B P is iterated from P = counts / (1 + share), and kept at zero or above; its
    error falls by `share` in each. What an acquisition's `scatter` and `scatter_mm` add, this
    estimates.

    Args:
        counts: primaries and scatter.
        share: of the primaries that is added, below 1.
        fwhm_mm: of the Gaussian B on the detector, full width at half maximum.
        cameras: that the pixels in mm belong to.
        iterations: of the primaries.

    Raises:
        ValueError: a share not in [0, 1), or counts that are negative or not finite.
    """
    if not 0 <= share < 1:
        raise ValueError(f"Expected a share of scatter in [0, 1), got {share}")
    check_counts(counts)
    primary = counts / (1 + share)
    for _ in range(iterations):
        primary = (counts - share * _smooth(primary, fwhm_mm, cameras)).clamp_min(0)
    return share * _smooth(primary, fwhm_mm, cameras)


def check_counts(counts: Tensor) -> None:
    """Refuse counts that no detector gives.

    Raises:
        ValueError: values that are negative or not finite.
    """
    bad = int((~(counts >= 0) | ~counts.isfinite()).sum())
    if bad:
        raise ValueError(
            f"Expected counts that are finite and not negative, got {bad} of {counts.numel()} that "
            f"are not"
        )


def _smooth(
    views: Float[Tensor, "b 1 m v u"], fwhm_mm: float, cameras: Cameras | None
) -> Float[Tensor, "b 1 m v u"]:
    if not fwhm_mm:
        return views
    if cameras is None:
        raise ValueError(f"Expected cameras for a smoothing of {fwhm_mm} mm, got None")
    return torch.stack([blurred(one, fwhm_mm, cameras) for one in views])
