"""Factors of a detector's pixels from the options of a command: uniformity, dead time, decay, and
the decays that one unit of activity makes."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from mvrecon.core.files.checks import Refused, file_errors, text_of
from mvrecon.core.quantities import NonNegativeFloat, PositiveFloat
from mvrecon.data.attenuation import CONCENTRATION
from mvrecon.data.projections.views import MeasuredViews
from mvrecon.geometry.cameras.camera import Cameras
from mvrecon_spect.methods.corrections import (
    MAX_HALF_LIVES,
    Read,
    decay_factors,
    live_factors,
    uniformity_factors,
)

#: Greatest relative difference between equal durations, for rounding.
MAX_DURATION_DIFFERENCE = 1e-3
#: Most photons per decay in one energy window: two of an annihilation, and some margin.
MAX_PHOTONS = 4


def detector(
    views: MeasuredViews,
    read: Read,
    cameras: Cameras,
    flood: str | Path | None = None,
    smoothing_mm: NonNegativeFloat = 0.0,
    half_life_s: PositiveFloat | None = None,
    start_s: float | Sequence[float] | str | Path | None = None,
    reference_s: float = 0.0,
    dead_time_us: NonNegativeFloat | None = None,
    paralysable: bool = False,
    in_window: PositiveFloat | None = None,
    time_s: PositiveFloat | None = None,
    branching: PositiveFloat | None = None,
) -> tuple[Float[Tensor, "m v u"], str | None]:
    """Factors w of the counts y = w A x, and the unit of x that they make: kBq/ml with `branching`,
    or None, any unit.

    Args:
        views: counts, with their duration and starts where the file has them.
        read: see `mvrecon_spect.methods.corrections.given`.
        cameras: cameras of the counts.
        flood: views of a uniform source by the same detectors, see `uniformity_factors`.
        smoothing_mm: FWHM of the Gaussian that smooths the flood.
        half_life_s: half-life of the isotope in s, for decay between and within the views.
        start_s: start of every view in s; one number for views that start together, or a text file
            of numbers. None: as in the file.
        reference_s: time in s, on the clock of `start_s`, of the activity that is reconstructed.
        dead_time_us: dead time in microseconds, see `live_factors`; 0 or None: none.
        paralysable: use the paralysable model.
        in_window: share of the registered events that are in the energy window of the views, for
            their rate; required with a dead time.
        time_s: duration of each view in s. None: as in the file.
        branching: photons in the energy window per decay; 99mTc: 0.89.

    Raises:
        Refused: a duration, starts or a share that are missing, of another number, or contradict
            the file; an option without the one that it belongs to; photons per decay in per cent.
        ValueError: see `uniformity_factors`, `live_factors` and `decay_factors`.
    """
    count, where = views.n_views, views.options.path
    for option, value, other, needed in (
        ("smoothing_mm", smoothing_mm, "flood", flood),
        ("start_s", start_s, "half_life_s", half_life_s),
        ("reference_s", reference_s, "half_life_s", half_life_s),
        ("in_window", in_window, "dead_time_us", dead_time_us),
        ("paralysable", paralysable, "dead_time_us", dead_time_us),
    ):
        if value and needed is None:
            raise Refused(
                f"{where}: expected factors.{other} with {option}={value}, which has no effect "
                f"without it, got none"
            )
    if branching and branching > MAX_PHOTONS:
        raise Refused(
            f"{where}: expected factors.branching as photons per decay, at most {MAX_PHOTONS}, got "
            f"{branching:g}; is it in per cent?"
        )
    weight = torch.ones(count, *cameras.shape, dtype=torch.float64)
    if flood is not None:
        counts = read(flood, relative=True)[0, 0]
        weight = weight * uniformity_factors(counts, None, cameras, smoothing_mm)
    stated = views.stack.duration_s
    if time_s and stated and abs(time_s / stated - 1) > MAX_DURATION_DIFFERENCE:
        raise Refused(f"{where}: expected factors.time_s={stated:g} by the file, got {time_s:g}")
    duration = time_s or stated
    if (half_life_s or dead_time_us or branching) and duration is None:
        raise Refused(f"{where}: expected factors.time_s, the duration of a view in s, got none")
    duration = duration or 1.0
    if half_life_s:
        if duration > MAX_HALF_LIVES * half_life_s:
            raise Refused(
                f"{where}: expected views of up to {MAX_HALF_LIVES} half-lives, got {duration:g} s "
                f"of factors.half_life_s={half_life_s:g}; is it in hours?"
            )
        starts = _starts(views, start_s)
        decay = decay_factors(starts, [duration] * count, half_life_s, reference_s)
        weight = weight * decay[:, None, None]
    if dead_time_us:
        if in_window is None or in_window > 1:
            raise Refused(
                f"{where}: expected factors.in_window, the share of the registered events in the "
                f"energy window, up to 1, with a dead time, got {in_window}"
            )
        sums = torch.cat(
            [part.sum(dim=(1, 2), dtype=torch.float64) for part in views.stack.chunks()]
        )
        rates = sums[:: views.options.every] / (duration * in_window)
        live = live_factors(rates.tolist(), 1e-6 * dead_time_us, paralysable)
        weight = weight * live[:, None, None]
    if branching is None:
        return weight, None
    return weight * (duration * branching), CONCENTRATION


def _starts(
    views: MeasuredViews, start_s: float | Sequence[float] | str | Path | None
) -> list[float]:
    """The start of each selected view in s."""
    where, count = views.options.path, views.stack.n_views
    if isinstance(start_s, str | Path):
        with file_errors(start_s, "has no starts", "expected one number per line, in s"):
            lines = text_of(Path(start_s).expanduser()).splitlines()
            start_s = np.loadtxt(lines, ndmin=1).ravel().tolist()
    starts = views.stack.starts_s if start_s is None else start_s
    if starts is None:
        raise Refused(
            f"{where}: expected factors.start_s, the start of every view in s (0 for views that "
            f"start together), got none, as the file does not state it"
        )
    starts = [float(starts)] * count if isinstance(starts, int | float) else [*starts]
    if len(starts) != count or not np.isfinite(starts).all():
        raise Refused(
            f"{where}: expected factors.start_s of {count} finite numbers, one per view of the "
            f"file, got {len(starts)}"
        )
    return starts[:: views.options.every]
