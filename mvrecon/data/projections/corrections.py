"""Grey values to line integrals: dark and flat fields, dead and saturated pixels, -log.

T = (I - D) / (F - D) is the transmission (Beer and Lambert), p = -ln T its line integral.
"""

import math
from typing import NamedTuple

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor

from mvrecon.files.checks import Refused


class Fields(NamedTuple):
    """Dark field D and contrast F - D in grey values, and the pixels that are not dead; the
    contrast of dead ones is 1.
    """

    dark: Float[Tensor, "v u"]
    contrast: Float[Tensor, "v u"]
    alive: Bool[Tensor, "v u"]


def fields(
    dark: Float[Tensor, "v u"],
    flat: Float[Tensor, "v u"],
    where: str,
    dead: float = 0.0,
    saturation: float = math.inf,
) -> Fields:
    """Dark field and contrast of a detector in grey values, and its dead pixels.

    Args:
        dark: grey values without a beam.
        flat: grey values without an object.
        where: they come from, for messages.
        dead: pixels whose contrast is at most this part of its median are dead.
        saturation: grey value; pixels that reach it in the flat field are dead, too.

    Raises:
        Refused: a flat field that is not above the dark one, or less than half of the pixels left.
    """
    contrast = flat - dark
    middle = contrast.median().item()
    if not middle > 0:
        raise Refused(
            f"{where}: expected a flat field above the dark one, got the medians "
            f"{flat.median().item():g} and {dark.median().item():g} (zero or swapped?)"
        )
    alive = (contrast > max(0.0, dead * middle)) & (flat < saturation)
    if 2 * int(alive.sum()) < alive.numel():
        raise Refused(
            f"{where}: expected at least half of the pixels between dark and saturated, got "
            f"{int(alive.sum())} of {alive.numel()}; flat field's largest grey value "
            f"{flat.max().item():g}, saturation {saturation:g}"
        )
    return Fields(dark, torch.where(alive, contrast, 1.0), alive)


def transmission(raw: Float[Tensor, "m v u"], known: Fields) -> Float[Tensor, "m v u"]:
    """Transmission from grey values; dead pixels get the mean of their neighbours."""
    values = (raw - known.dark) / known.contrast
    return values if known.alive.all() else filled(values, known.alive)


def filled(values: Float[Tensor, "m v u"], alive: Bool[Tensor, "v u"]) -> Float[Tensor, "m v u"]:
    """Values whose dead pixels have the mean of the living ones around them (3 x 3 pixels, as often
    as it takes to fill a cluster from its edge).
    """
    weights = alive[None, None].to(values)
    values = values[:, None] * weights
    while not (done := weights > 0).all():
        near = F.avg_pool2d(weights, 3, 1, 1)
        means = F.avg_pool2d(values, 3, 1, 1) / near.clamp(min=1e-6)
        values = torch.where(done, values, means)
        weights = (near > 0).to(values)
        values = values * weights
    return values[:, 0]


def integrals(
    values: Float[Tensor, "m v u"], floor: float
) -> tuple[Float[Tensor, "m v u"], Bool[Tensor, "m v u"]]:
    """Line integrals -ln of transmissions, of `floor` where less arrives, and where that is."""
    low = values <= floor
    return -values.clamp(min=floor).log(), low
