"""The detector: blur, scatter, photons, counts and electronic noise, as functions of views."""

import math
import warnings
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from mvrecon.data.acquisition.settings import Acquisition
from mvrecon.geometry.cameras.camera import Cameras

#: A pixel's least number of photons, so that its logarithm exists.
FLOOR = 0.5
#: The share of pixels that may expect less than one photon without a warning.
STARVED = 0.01
#: Standard deviations in a Gaussian's full width at half maximum.
WIDTH = 2 * math.sqrt(2 * math.log(2))


def detected(
    views: Float[Tensor, "1 m v u"],
    acquisition: Acquisition,
    cameras: Cameras,
    rng: torch.Generator,
) -> Float[Tensor, "1 m v u"]:
    """The detector turns ideal views into measured ones of the same unit.

    Args:
        views: line integrals without a unit where there are photons, else in the projector's unit.
        acquisition: of the detector.
        cameras: that the pixels in mm belong to.
        rng: of the noise.

    Raises:
        ValueError: counts of negative views.
    """
    if acquisition.perfect:
        return views
    ideal = views.double()
    if acquisition.photons is not None:
        measured = _transmission(ideal, acquisition, cameras, rng)
    else:
        measured = _emission(emitted(ideal, acquisition, cameras), acquisition, rng)
    return measured.to(views)


def _transmission(
    y: Float[Tensor, "1 m v u"], acquisition: Acquisition, cameras: Cameras, rng: torch.Generator
) -> Float[Tensor, "1 m v u"]:
    intensity, photons = torch.exp(-y), acquisition.photons or math.inf
    share = blurred(intensity, acquisition.blur_mm, cameras)
    if acquisition.scatter:
        share = share + acquisition.scatter * blurred(
            y * intensity, acquisition.scatter_mm, cameras
        )
    if photons == math.inf:
        return -torch.log(share.clamp(min=torch.finfo(torch.float32).tiny))
    expected = share.clamp(min=0) * photons
    if float((expected < 1).double().mean()) > STARVED:
        warnings.warn(
            f"More than {STARVED:.0%} of the pixels of a case expect less than one photon at "
            f"photons={photons:g}: expected line integrals below {math.log(photons):.3g}, got up "
            f"to more; is the scene in 1/mm (water is 0.0192, as by scene.value=0.02)?",
            RuntimeWarning,
            stacklevel=2,
        )
    number = torch.poisson(expected, generator=rng) + _electronic(expected, acquisition, rng)
    return -torch.log(number.clamp(min=FLOOR) / photons)


class Counted(NamedTuple):
    """Counts of one case.

    Args:
        number: Poisson numbers.
        dose: their expectation per unit of the views; 0 where nothing is seen.
    """

    number: Float[Tensor, "1 m v u"]
    dose: float


def counted(
    views: Float[Tensor, "1 m v u"], acquisition: Acquisition, rng: torch.Generator
) -> Counted:
    """Poisson numbers of ideal views, `acquisition.counts` expected in all of them together.

    Raises:
        ValueError: negative views.
    """
    total = float(views.sum())
    if float(views.min()) < 0:
        raise ValueError(
            f"Counts need views of at least 0, got {float(views.min()):.4g}; use noise, or photons "
            f"for line integrals"
        )
    dose = (acquisition.counts or 0.0) / total if total else 0.0
    return Counted(torch.poisson(views * dose, generator=rng), dose)


def emitted(
    views: Float[Tensor, "1 m v u"], acquisition: Acquisition, cameras: Cameras
) -> Float[Tensor, "1 m v u"]:
    """Ideal views blurred by the detector, and scatter added, in their unit; float64."""
    primary = blurred(views.double(), acquisition.blur_mm, cameras)
    return primary + acquisition.scatter * blurred(primary, acquisition.scatter_mm, cameras)


def _emission(
    views: Float[Tensor, "1 m v u"], acquisition: Acquisition, rng: torch.Generator
) -> Float[Tensor, "1 m v u"]:
    if acquisition.counts is None or not views.any():
        return views + _electronic(views, acquisition, rng)
    number, dose = counted(views, acquisition, rng)
    return (number + _electronic(views, acquisition, rng)) / dose


def _electronic(like: Tensor, acquisition: Acquisition, rng: torch.Generator) -> Tensor | float:
    if not acquisition.noise:
        return 0.0
    return acquisition.noise * torch.randn(like.shape, generator=rng, dtype=like.dtype)


def blurred(
    views: Float[Tensor, "1 m v u"], fwhm_mm: float, cameras: Cameras
) -> Float[Tensor, "1 m v u"]:
    """Views blurred on the detector by a Gaussian of this full width at half maximum in mm.

    Along columns, then along rows; each weight is the Gaussian's integral over a pixel. At the
    detector's edge the weights are those of the pixels that are there, divided by their sum: a
    uniform view stays as it is.
    """
    if not fwhm_mm:
        return views
    rows, columns = cameras.shape
    along_v = _weights(cameras.v.detach().norm(dim=-1), rows, fwhm_mm).to(views)
    along_u = _weights(cameras.u.detach().norm(dim=-1), columns, fwhm_mm).to(views)
    return along_v @ views @ along_u.mT


def _weights(
    pitch: Float[Tensor, " m"], count: int, fwhm_mm: float
) -> Float[Tensor, "#m count count"]:
    """Weights of each pixel's neighbours along one axis; one matrix where all pitches are one."""
    if pitch.max() - pitch.min() <= 1e-9 * pitch.max():
        pitch = pitch[:1]
    index = torch.arange(count, dtype=torch.float64, device=pitch.device)
    apart = index[:, None] - index
    unit = pitch[:, None, None] * WIDTH / (fwhm_mm * math.sqrt(2))
    whole = torch.erf((apart + 0.5) * unit) - torch.erf((apart - 0.5) * unit)
    return whole / whole.sum(dim=-1, keepdim=True)
