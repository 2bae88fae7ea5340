"""Options of an acquisition, with their units."""

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields
from typing import Any

from mvrecon.core.quantities import NonNegativeFloat, PositiveFloat, PositiveInt
from mvrecon.core.registry import check_options
from mvrecon.data.acquisition.disturbances import Disturbance


@dataclass(frozen=True, kw_only=True)
class Acquisition:
    """The acquisition describes a detector, with lengths in mm and noise in photons or counts.

    The default is a perfect detector: views are what the projector makes of the object. With
    `photons` blur and scatter act on the intensity exp(-y); else on the views y.

    Args:
        fine: the grid that views are projected from is this many times finer than the
            reconstruction's, at least 2. Projectors of line integrals do without: an analytic
            phantom has them in closed form, a file's scene has its own option `fine`.
        blur_mm: of the detector, full width at half maximum of a Gaussian.
        scatter: share of the primary that is added, blurred. With `photons` it is a share of the
            intensity times its line integral, y exp(-y), so that air has none (Ohnesorge, Flohr,
            Klingenbeck-Regn, Eur. Radiol. 9 (1999) 563, convolve weighted projections likewise).
        scatter_mm: blur of the scattered part, full width at half maximum of a Gaussian.
        photons: on a pixel without an object in the beam (I0); the views are -log of Poisson
            numbers per I0, half a photon at least. inf: no noise. None: views are not intensities.
        counts: of all views of a case together; the views are Poisson numbers, scaled back to the
            projector's unit. None: no counts.
        noise: standard deviation of the electronics, Gaussian and additive: in photons with
            `photons`, in counts with `counts`, else in the views' unit.
        closed_form: whether projectors of line integrals take a scene's own, in closed form; False:
            they are built on the finer grid as any other is, which is faster where a phantom has
            many solids, and has that grid's discretisation in it.
        disturbed: errors of some views that nobody knows, before all that the detector does.

    Raises:
        TypeError: an option that is no number, or a closed_form that is neither true nor false.
        ValueError: numbers that are too small or not finite; photons and counts at once; counts of
            overexposed views.
    """

    fine: PositiveInt = 2
    blur_mm: NonNegativeFloat = 0.0
    scatter: NonNegativeFloat = 0.0
    scatter_mm: PositiveFloat = 40.0
    photons: PositiveFloat | None = None
    counts: PositiveFloat | None = None
    noise: NonNegativeFloat = 0.0
    closed_form: bool = True
    disturbed: Disturbance | None = None

    def __post_init__(self) -> None:
        for name, value in asdict(self).items():
            if name not in ("disturbed", "closed_form"):
                self._check(name, value)
        if not isinstance(self.closed_form, bool):
            raise TypeError(
                f"Expected acquisition.closed_form as true or false, got {self.closed_form!r}"
            )
        if self.photons is not None and self.counts is not None:
            raise ValueError(
                f"An acquisition has photons (transmission) or counts (emission), got photons "
                f"{self.photons} and counts {self.counts}"
            )
        if self.photons == math.inf and self.noise:
            raise ValueError(
                f"Electronic noise is in photons, so photons must be finite, got photons inf and "
                f"noise {self.noise}"
            )

        if self.counts is not None and self.disturbed is not None and self.disturbed.saturated:
            raise ValueError(
                f"disturbed.saturated is of overexposed line integrals; expected no counts, got "
                f"{self.counts}"
            )

    @classmethod
    def of(cls, options: Mapping[str, Any] | None) -> "Acquisition":
        """The acquisition that a mapping describes; of None, the perfect detector.

        Raises:
            TypeError: not a mapping, or an unknown option; the message gives the nearest.
        """
        known = [field.name for field in fields(cls)]
        if options is not None and not isinstance(options, Mapping):
            raise TypeError(
                f"An acquisition is a mapping of {', '.join(known)}, got {options!r}; choose a "
                f"file by acquisition=<name>"
            )
        check_options("An acquisition", options or {}, known)
        values = {**(options or {})}
        if values.get("disturbed") is not None:
            values["disturbed"] = Disturbance.of(values["disturbed"])
        return cls(**values)

    @property
    def perfect(self) -> bool:
        """Whether the detector adds nothing to what the projector makes."""
        spoilt = (self.blur_mm, self.scatter, self.photons, self.counts, self.noise)
        return not any(spoilt)

    def _check(self, name: str, value: Any) -> None:
        if value is None and name in ("photons", "counts"):
            return
        if not isinstance(value, int | float) or isinstance(value, bool):
            raise TypeError(f"Expected acquisition.{name} as a number, got {value!r}")
        expected, fits = "a number of at least 0", value >= 0 and math.isfinite(value)
        if name == "fine":
            expected, fits = "a whole number of at least 2", value >= 2 and value == int(value)
        elif name in ("photons", "counts", "scatter_mm"):
            expected = "a positive number"
            fits = value > 0 and (math.isfinite(value) or name == "photons")
        if not fits:
            raise ValueError(f"Expected acquisition.{name} as {expected}, got {value}")
