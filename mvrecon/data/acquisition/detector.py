"""The detector: options of an acquisition with their units, and blur, scatter, photons, spectrum,
counts and electronic noise as functions of views.
"""

import math
import warnings
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any, NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from mvrecon.core.quantities import NonNegativeFloat, PositiveFloat, PositiveInt
from mvrecon.core.registry import from_options
from mvrecon.data.acquisition.disturbances import Disturbance
from mvrecon.data.acquisition.spectra import tube
from mvrecon.geometry.cameras.camera import Cameras


@dataclass(frozen=True, kw_only=True)
class Acquisition:
    """Options of a detector, with lengths in mm and noise in photons or counts.

    The default is a perfect detector: views are the projector's output. With `photons` blur and
    scatter act on the intensity exp(-y); else on the views y.

    Args:
        fine: refinement of the grid that views are projected from relative to the reconstruction's,
            at least 2. Ignored for line integrals: an analytic phantom has them in closed form, a
            file's scene its own option `fine`.
        rays: lines each way over a pixel, whose mean it measures on the finer grid; as `fine`.
        blur_mm: blur of the detector: full width at half maximum of a Gaussian, in mm.
        scatter: share of the primary that is added, blurred. With `photons` it is a share of the
            intensity times its line integral, y exp(-y), so that air scatters nothing (Ohnesorge,
            Flohr, Klingenbeck-Regn, Eur. Radiol. 9 (1999) 563, convolve weighted projections
            likewise).
        scatter_mm: blur of the scattered part, full width at half maximum of a Gaussian.
        photons: number of photons of an unattenuated pixel (I0); the views are -log of Poisson
            numbers per I0, at least half a photon. inf: no noise. None: views are not intensities.
        counts: total of all views of a case without gains and losses; the views are Poisson
            numbers, divided by their dose (expected counts per unit) to be in the projector's unit;
            the views.h5 of `mvrecon-simulate` holds the counts themselves. None: no counts.
        kv: voltage of an X-ray tube, 80 or 120, whose beam hardens as in water; the scene's
            attenuation is that at 70 keV. Requires `photons`, whose number is that of the mean
            signal's. None: photons of one energy.
        integrating: the detector sums the energies of the photons of `kv`; False: it counts them.
        duration_s: duration of the measurement of `counts`, in s, stored with them: estimates of
            scatter from another file scale its counts to the same duration.
        noise: standard deviation of the electronics, Gaussian and additive: in photons with
            `photons`, in counts with `counts`, else in the views' unit.
        closed_form: use a scene's own closed-form line integrals; False: project on the finer grid,
            which is faster for phantoms of many solids, and adds that grid's discretisation.
        disturbed: unknown errors of some views; all but `dead` act before the detector.

    Raises:
        TypeError: an option that is not a number, or a closed_form that is not a bool.
        ValueError: numbers that are too small or not finite; both photons and counts; counts of
            overexposed views; an unknown tube, or one without photons.
    """

    fine: PositiveInt = 2
    rays: PositiveInt = 1
    blur_mm: NonNegativeFloat = 0.0
    scatter: NonNegativeFloat = 0.0
    scatter_mm: PositiveFloat = 40.0
    photons: PositiveFloat | None = None
    counts: PositiveFloat | None = None
    kv: PositiveFloat | None = None
    integrating: bool = True
    duration_s: PositiveFloat = 1.0
    noise: NonNegativeFloat = 0.0
    closed_form: bool = True
    disturbed: Disturbance | None = None

    def __post_init__(self) -> None:
        for name, value in asdict(self).items():
            if name in ("disturbed", "closed_form", "integrating"):
                continue
            if value is None and name in ("photons", "counts", "kv"):
                continue
            if not isinstance(value, int | float) or isinstance(value, bool):
                raise TypeError(f"Expected acquisition.{name} as a number, got {value!r}")
            expected, fits = "a number of at least 0", value >= 0 and math.isfinite(value)
            if name in ("fine", "rays"):
                least = 2 if name == "fine" else 1
                expected = f"a whole number of at least {least}"
                fits = value >= least and value == int(value)
            elif name in ("photons", "counts", "scatter_mm", "kv"):
                expected = "a positive number"
                fits = value > 0 and (math.isfinite(value) or name == "photons")
            if not fits:
                raise ValueError(f"Expected acquisition.{name} as {expected}, got {value}")
        for name in ("closed_form", "integrating"):
            if not isinstance(flag := getattr(self, name), bool):
                raise TypeError(f"Expected acquisition.{name} as true or false, got {flag!r}")
        if self.kv is not None and tube(self.kv) and self.photons is None:
            raise ValueError(
                f"Expected acquisition.photons (inf: no noise) with kv={self.kv:g}, got none"
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

        of_integrals = ("saturated", "rod") if self.counts is not None and self.disturbed else ()
        for name in of_integrals:
            if getattr(self.disturbed, name):
                raise ValueError(
                    f"disturbed.{name} is of line integrals; expected no counts, got {self.counts}"
                )

    @classmethod
    def of(cls, options: Mapping[str, Any] | None) -> "Acquisition":
        """Build an acquisition from a mapping; None is the perfect detector.

        Raises:
            TypeError: not a mapping, or an unknown option; the message gives the nearest.
        """
        values = {} if options is None else options
        if isinstance(values, Mapping) and values.get("disturbed") is not None:
            errors = from_options(Disturbance, "disturbed", values["disturbed"])
            values = {**values, "disturbed": errors}
        return from_options(cls, "An acquisition", values)

    @property
    def perfect(self) -> bool:
        """Whether the detector leaves the projector's output unchanged."""
        spoilt = (self.blur_mm, self.scatter, self.photons, self.counts, self.noise)
        return not any(spoilt)


#: Least number of photons of a pixel, so that its logarithm exists.
MIN_PHOTONS = 0.5
#: Share of pixels that may expect less than one photon without a warning.
MAX_STARVED_SHARE = 0.01
#: Standard deviations in a Gaussian's full width at half maximum.
FWHM_PER_SIGMA = 2 * math.sqrt(2 * math.log(2))


class Detected(NamedTuple):
    """Measured views of one case.

    Args:
        views: measured views, in the unit of the ideal ones.
        dose: expected counts per unit, by which counts were divided; None: no counts.
    """

    views: Float[Tensor, "1 m v u"]
    dose: float | None = None


def detected(
    views: Float[Tensor, "1 m v u"],
    acquisition: Acquisition,
    cameras: Cameras,
    rng: torch.Generator,
    intended: Float[Tensor, "1 m v u"] | None = None,
) -> Float[Tensor, "1 m v u"]:
    """The views of `measured`."""
    return measured(views, acquisition, cameras, rng, intended).views


def measured(
    views: Float[Tensor, "1 m v u"],
    acquisition: Acquisition,
    cameras: Cameras,
    rng: torch.Generator,
    intended: Float[Tensor, "1 m v u"] | None = None,
    extra_scatter: Float[Tensor, "m 1 1"] | float = 0.0,
) -> Detected:
    """Convert ideal views to measured ones of the same unit.

    Args:
        views: line integrals without a unit with photons, else in the projector's unit.
        acquisition: options of the detector.
        cameras: give the size of pixels in mm.
        rng: generator of the noise.
        intended: the views without gains and losses, whose counts set the exposure: a blocked
            pinhole leaves the others as many as before. None: `views`.
        extra_scatter: scatter-to-primary ratio of each view beside the acquisition's.

    Raises:
        ValueError: counts of negative views.
    """
    scatters = isinstance(extra_scatter, Tensor) and bool(extra_scatter.any())
    if acquisition.perfect and not scatters:
        return Detected(views)
    ideal, photons = views.double(), acquisition.photons

    def noise(counts: Tensor) -> Tensor | float:
        if not acquisition.noise:
            return 0.0
        return acquisition.noise * torch.randn(counts.shape, generator=rng, dtype=counts.dtype)

    if photons is None:
        emission, exposed = (
            emitted(one, acquisition, cameras, extra_scatter)
            for one in (ideal, ideal if intended is None else intended)
        )
        total = float(exposed.sum())
        if acquisition.counts is None or not total:
            return Detected((emission + noise(emission)).to(views))
        number, dose = counted(emission, acquisition, rng, total)
        return Detected(((number + noise(emission)) / dose).to(views), dose)
    intensity = (
        torch.exp(-ideal)
        if acquisition.kv is None
        else tube(acquisition.kv, acquisition.integrating).transmission(ideal)
    )
    share = blurred(intensity, acquisition.blur_mm, cameras)
    if acquisition.scatter or scatters:
        scattered = blurred(ideal * intensity, acquisition.scatter_mm, cameras)
        share = share + (acquisition.scatter + extra_scatter) * scattered
    if photons == math.inf:
        return Detected(-torch.log(share.clamp(min=torch.finfo(torch.float32).tiny)).to(views))
    expected = share.clamp(min=0) * photons
    if float((expected < 1).double().mean()) > MAX_STARVED_SHARE:
        warnings.warn(
            f"More than {MAX_STARVED_SHARE:.0%} of the pixels of a case expect less than one "
            f"photon at photons={photons:g}: expected line integrals below "
            f"{math.log(photons):.3g}, got up to more; is the scene in 1/mm (water is 0.0192, as "
            "by scene.value=0.02)?",
            RuntimeWarning,
            stacklevel=3,
        )
    number = torch.poisson(expected, generator=rng) + noise(expected)
    return Detected(-torch.log(number.clamp(min=MIN_PHOTONS) / photons).to(views))


class Counted(NamedTuple):
    """Counts of one case.

    Args:
        number: Poisson numbers.
        dose: their expectation per unit of the views; 0 for empty views.
    """

    number: Float[Tensor, "1 m v u"]
    dose: float


def counted(
    views: Float[Tensor, "1 m v u"],
    acquisition: Acquisition,
    rng: torch.Generator,
    total: float | None = None,
) -> Counted:
    """Draw Poisson numbers of ideal views, of which `total`, by default their sum, expects
    `acquisition.counts`.

    Raises:
        ValueError: negative views.
    """
    total = float(views.sum()) if total is None else total
    if float(views.min()) < 0:
        raise ValueError(
            f"Counts need views of at least 0, got {float(views.min()):.4g}; use noise, or photons "
            f"for line integrals"
        )
    dose = (acquisition.counts or 0.0) / total if total else 0.0
    return Counted(torch.poisson(views * dose, generator=rng), dose)


def emitted(
    views: Float[Tensor, "1 m v u"],
    acquisition: Acquisition,
    cameras: Cameras,
    extra_scatter: Float[Tensor, "m 1 1"] | float = 0.0,
) -> Float[Tensor, "1 m v u"]:
    """Blur ideal views by the detector and add scatter, in their unit; float64."""
    primary = blurred(views.double(), acquisition.blur_mm, cameras)
    ratio = acquisition.scatter + extra_scatter
    return primary + ratio * blurred(primary, acquisition.scatter_mm, cameras)


def blurred(
    views: Float[Tensor, "1 m v u"], fwhm_mm: float, cameras: Cameras
) -> Float[Tensor, "1 m v u"]:
    """Blur views on the detector by a Gaussian of this full width at half maximum in mm.

    Along columns, then along rows; each weight is the Gaussian's integral over a pixel, normalised
    over the pixels inside the detector: uniform views are unchanged.
    """
    if not fwhm_mm:
        return views
    rows, columns = cameras.shape
    along_v = gaussian_weights(cameras.v.detach().norm(dim=-1), rows, fwhm_mm).to(views)
    along_u = gaussian_weights(cameras.u.detach().norm(dim=-1), columns, fwhm_mm).to(views)
    return along_v @ views @ along_u.mT


def gaussian_weights(
    pitch: Float[Tensor, " m"], count: int, fwhm_mm: float
) -> Float[Tensor, "#m count count"]:
    """Weights of each pixel's neighbours along one axis; one matrix if all pitches are equal."""
    if pitch.max() - pitch.min() <= 1e-9 * pitch.max():
        pitch = pitch[:1]
    index = torch.arange(count, dtype=torch.float64, device=pitch.device)
    apart = index[:, None] - index
    unit = pitch[:, None, None] * FWHM_PER_SIGMA / (fwhm_mm * math.sqrt(2))
    whole = torch.erf((apart + 0.5) * unit) - torch.erf((apart - 0.5) * unit)
    return whole / whole.sum(dim=-1, keepdim=True)
