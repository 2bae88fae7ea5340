"""What every network shares with the classical methods: a start from SIRT, a scale, and
data-consistency steps.
"""

from collections.abc import Mapping
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn

from mvrecon.geometry.grid import Grid
from mvrecon.models.geometry import Geometry
from mvrecon.parts import RECONSTRUCTORS
from mvrecon.reconstruct.iterative import sirt


class Consistency(nn.Module):
    """A few learned-length gradient steps towards the data, x + lambda_k C A^T R (y - A x).

    C and R are the inverse column and row sums of A (SIRT, Gregor & Benson 2008), so a step of
    length one is stable for every rig. The steps' lengths are learned, as in ItNet (Genzel et al.
    2022).

    Args:
        steps: how many; none leaves the volume as it is.
    """

    def __init__(self, steps: int):
        super().__init__()
        self.lengths = nn.Parameter(torch.ones(steps))

    def forward(
        self,
        geometry: Geometry,
        volume: Float[Tensor, "b 1 d h w"],
        views: Float[Tensor, "b 1 m v u"],
        sigma: Float[Tensor, "b 1 1 1 1"] | None = None,
    ) -> Float[Tensor, "b 1 d h w"]:
        """The volume after the steps.

        With `sigma`, the noise of the views in their unit, a sample takes no further step once
        chi^2 per measurement, the mean of ((y - A x) / sigma)^2, is at most 1. In training every
        sample takes every step.
        """
        for length in self.lengths:
            residual = views - geometry.A(volume)
            if sigma is None or self.training:
                volume = volume + length * geometry.back(residual)
                continue
            unmet = (residual / sigma).square().mean(dim=(1, 2, 3, 4), keepdim=True) > 1
            if not unmet.any():
                break
            volume = volume + length * unmet * geometry.back(residual)
        return volume


#: Iterations of SIRT with momentum, or a reconstructor as a mapping: its name and options.
Start = int | Mapping[str, Any]


def checked_start(start: Start) -> Start:
    """The start of a model, of a reconstructor that there is.

    Raises:
        LookupError: an unknown name.
        TypeError: an option that the reconstructor does not have, or a mapping without a name.
    """
    if isinstance(start, Mapping):
        RECONSTRUCTORS.check(start)
    return start


def normalised(
    geometry: Geometry, views: Float[Tensor, "b 1 m v u"], start: Start
) -> tuple[Float[Tensor, "b 1 k v u"], Float[Tensor, "b 1 d h w"], Float[Tensor, "b 1 1 1 1"]]:
    """Views and their classical start, both divided by the content's scale, and that
    scale.

    The start is SIRT with momentum from zero, non-negative, or another reconstructor; it is not
    differentiated. The scale of views of nothing is zero.
    """
    with torch.no_grad():
        if isinstance(start, Mapping):
            x = _reconstructed(geometry, views, start)
        else:
            x = sirt(geometry.A, views, start, weights=geometry.weights, momentum=True)
    scale = content_scale(x)
    return views / scale, x / scale, scale * anything(views)


def _reconstructed(
    geometry: Geometry, views: Float[Tensor, "b 1 m v u"], start: Mapping[str, Any]
) -> Float[Tensor, "b 1 d h w"]:
    """The volume of a reconstructor within each sample's mask.

    Its views are scaled to a mean density of the rays of about one before, so that a weight of its
    options is relative to the content.
    """
    level = content_scale(views) / typical_chord(geometry.A.grid)
    y, mask = views / level, geometry.mask
    if mask is None:
        return RECONSTRUCTORS.from_config(start, geometry.A, y) * level
    samples = zip(y.split(1), mask[:, 0], strict=True)
    volumes = [
        RECONSTRUCTORS.from_config(start, geometry.A, own, support=support)
        for own, support in samples
    ]
    return torch.cat(volumes) * level


def content_scale(volume: Float[Tensor, "b 1 d h w"]) -> Float[Tensor, "b 1 1 1 1"]:
    """The value of what is there, sum x^2 / sum |x|: v for any object of one value v, however
    small.

    Dividing by it makes a network's answer scale with its input: f(a y) = a f(y). One for an empty
    volume. Relative to the largest value, whose square may be no number of the dtype.
    """
    peak = volume.abs().amax(dim=(1, 2, 3, 4), keepdim=True)
    peak = torch.where(peak > 0, peak, 1.0)
    part = (volume / peak).abs()
    scale = part.square().sum(dim=(1, 2, 3, 4), keepdim=True) / part.sum(
        dim=(1, 2, 3, 4), keepdim=True
    ).clamp_min(1)
    return torch.where(scale > 0, scale * peak, 1.0)


def typical_chord(grid: Grid) -> float:
    """The length in mm by which a network's views are divided, so that it sees densities and no
    unit of length.

    Of the whole grid, since a crop's would change with the crop.
    """
    return max(grid.shape) * min(grid.spacing)


def anything(views: Float[Tensor, "b 1 m v u"]) -> Float[Tensor, "b 1 1 1 1"]:
    """One where views show anything, zero where they show nothing: f(0) = 0."""
    return views.flatten(1).any(dim=1).to(views.dtype).reshape(-1, 1, 1, 1, 1)
