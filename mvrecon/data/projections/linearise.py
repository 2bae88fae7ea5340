"""Beam hardening in one material: a polynomial turns the line integrals of a beam of many energies
into those of photons of one energy (Herman, Correction for beam hardening in computed tomography,
Phys. Med. Biol. 24, 1979).
"""

from collections.abc import Sequence

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from mvrecon.core.files.checks import Refused

#: Points of a range at which the slope of a polynomial is computed.
SLOPES = 1025


def linearised(
    p: Float[Tensor, "*n"], coefficients: Sequence[float], where: Bool[Tensor, "*n"]
) -> Float[Tensor, "*n"]:
    """The polynomial c1 p + c2 p^2 + ... of line integrals.

    Args:
        p: line integrals.
        coefficients: c1, c2, ..., without a unit.
        where: measured pixels, over whose range the polynomial must grow.

    Raises:
        Refused: a polynomial that falls between two of their values, or between one and zero.
    """
    ends = torch.stack((p[where] if where.any() else p).aminmax()).double().cpu()
    places = torch.linspace(
        ends[0].clamp_max(0).item(), ends[1].clamp_min(0).item(), SLOPES, dtype=torch.float64
    )
    slopes = torch.zeros_like(places)
    for k, c in reversed([*enumerate(coefficients, start=1)]):
        slopes = slopes * places + k * c
    if (falling := ~((slopes > 0) & slopes.isfinite())).any():
        wrong = places[falling]
        raise Refused(
            f"expected linearise (views.linearise) as a polynomial that grows over the line "
            f"integrals of the views, from {places[0]:.4g} to {places[-1]:.4g}, got "
            f"{list(coefficients)}, which falls at {wrong[wrong.abs().argmin()]:.4g}; fit it to an "
            f"object at least as thick, or clip the views by views.floor"
        )
    total = torch.zeros_like(p)
    for c in reversed(coefficients):
        total = (total + c) * p
    return total
