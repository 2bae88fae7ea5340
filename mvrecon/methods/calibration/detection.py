"""Markers in views: their places on the detector, to a fraction of a pixel."""

import torch
from jaxtyping import Float
from torch import Tensor

from mvrecon.geometry.grid import pixel_centres

#: Rounds in which a window is centred on its marker anew.
CENTRINGS = 5
#: A marker must rise above its background by so many times the background's spread.
CONTRAST = 5.0


def helix(
    count: int = 24, radius_mm: float = 40.0, height_mm: float = 80.0, turns: float = 2.0
) -> Float[Tensor, "n 3"]:
    """Marker phantom in world mm: balls on a helix about the z axis, in order.

    Args:
        count: number of balls, at least six.
        radius_mm, height_mm: of the helix, its middle at the origin.
        turns: of the helix; not whole, so that no two balls are one above the other.

    Raises:
        ValueError: fewer than six balls.
    """
    if count < 6:
        raise ValueError(f"expected at least six markers, got {count}")
    share = torch.linspace(0, 1, count, dtype=torch.float64)
    angle = 2 * torch.pi * turns * share
    height = (share - 0.5) * height_mm
    return torch.stack([radius_mm * angle.cos(), radius_mm * angle.sin(), height], dim=-1)


def centroids(
    views: Float[Tensor, "m v u"], guesses: Float[Tensor, "m n 2"], radius_px: float = 5.0
) -> Float[Tensor, "m n 2"]:
    """Places (u, v) of markers in pixels: centroids of what rises above the background near a
    guess.

    In a disc about the guess the background is a plane through its rim, and the disc is centred on
    the centroid anew, `CENTRINGS` times. NaN where there is no marker, where the disc leaves the
    detector, and where another guess is within two radii. A ball's centroid differs from its
    centre's image by the cone's obliquity, far below a hundredth of a pixel for small balls.

    Args:
        views: integrals in which markers are bright.
        guesses: where markers should be, as the nominal rig projects them.
        radius_px: of the disc; it must hold the marker and the error of the guess.

    Raises:
        ValueError: shapes that do not agree, or a radius below two pixels.
    """
    if guesses.ndim != 3 or guesses.shape[0] != len(views) or guesses.shape[2] != 2:
        raise ValueError(
            f"expected guesses [{len(views)} n 2], one row a view, got {list(guesses.shape)}"
        )
    if not radius_px >= 2:
        raise ValueError(f"expected a radius of at least 2 pixels, got {radius_px}")
    pixels = pixel_centres(views.shape[1:])
    result = torch.full_like(guesses, torch.nan, dtype=torch.float64)
    for m, (view, places) in enumerate(zip(views.double(), guesses.double(), strict=True)):
        apart = torch.cdist(places, places) + torch.diag(torch.full((len(places),), torch.inf))
        for n in (apart.amin(dim=1) > 2 * radius_px).nonzero()[:, 0].tolist():
            result[m, n] = _centroid(view, pixels, places[n], radius_px)
    return result


def _centroid(
    view: Float[Tensor, "v u"], pixels: Float[Tensor, "v u 2"], place: Tensor, radius: float
) -> Float[Tensor, "2"]:
    last = place.new_tensor(view.shape[::-1]) - 1
    for _ in range(CENTRINGS):
        if not ((place - radius >= 0) & (place + radius <= last)).all():
            return place.new_full((2,), torch.nan)
        low = (place - radius).floor().long().tolist()
        window = tuple(slice(n, n + round(2 * radius) + 2) for n in reversed(low))
        values, at = view[window], pixels[window]
        distance = (at - place).norm(dim=-1)
        slope = torch.cat([at - place, torch.ones_like(at[..., :1])], dim=-1)
        rim = (distance > radius - 1) & (distance <= radius)
        plane = torch.linalg.lstsq(slope[rim], values[rim][:, None]).solution
        above = values - (slope @ plane)[..., 0]
        spread = above[rim].std()
        weight = torch.where(distance <= radius, above, 0.0).clamp(min=0)
        if not weight.max() > CONTRAST * spread + 1e-12:
            return place.new_full((2,), torch.nan)
        # a rim's noise is not weight: the lower part of the peak is left out
        weight = (weight - 0.1 * weight.max()).clamp(min=0)
        place = (weight[..., None] * at).sum(dim=(0, 1)) / weight.sum()
    return place
