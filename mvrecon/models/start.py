"""What networks begin with: a classical volume, and the scale by which they divide everything."""

from collections.abc import Mapping
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from mvrecon.geometry.grid import Grid
from mvrecon.models.fingerprints import fingerprints
from mvrecon.models.geometry import Geometry
from mvrecon.parts import RECONSTRUCTORS
from mvrecon.reconstructors.iterative import sirt

#: Iterations of SIRT with momentum, or a reconstructor as a mapping: its name and options.
Start = int | Mapping[str, Any]
#: Bytes of volumes that a training keeps at most.
ROOM = 2 << 30


class ClassicalStart:
    """The volume that a network begins with, by SIRT with momentum or another reconstructor, in the
    unit of (views / mm).

    It is not differentiated. In training another reconstructor's volume of a case is computed once
    and kept, as long as there is room: views of a training case are the same in every epoch.

    Args:
        start: iterations of SIRT with momentum, or a reconstructor: `{name: ..., **options}`.

    Raises:
        LookupError: an unknown name.
        TypeError: an option that the reconstructor does not have, or a mapping without a name.
    """

    def __init__(self, start: Start):
        if isinstance(start, Mapping):
            RECONSTRUCTORS.check(start)
        self.start = start
        self._known: dict[bytes, Float[Tensor, "1 1 d h w"]] = {}
        self._room = ROOM

    @torch.no_grad()
    def __call__(
        self, geometry: Geometry, views: Float[Tensor, "b 1 m v u"], training: bool = False
    ) -> Float[Tensor, "b 1 d h w"]:
        """The volumes of views within each sample's mask."""
        if not isinstance(self.start, Mapping):
            A, weights = geometry.A, geometry.weights
            return sirt(A, views, self.start, weights=weights, momentum=True)
        samples = range(len(views))
        if not training:
            return torch.cat([self._made(geometry, views, sample) for sample in samples])
        names, volumes = fingerprints(views), []
        for sample, name in zip(samples, names, strict=True):
            volume = self._known.get(name)
            if volume is None:
                volume = self._made(geometry, views, sample)
                self._keep(name, volume)
            volumes.append(volume.to(views))
        return torch.cat(volumes)

    def _keep(self, name: bytes, volume: Tensor) -> None:
        if volume.nbytes <= self._room:
            self._room -= volume.nbytes
            self._known[name] = volume.cpu()

    def _made(self, geometry: Geometry, views: Tensor, sample: int) -> Tensor:
        """The reconstructor's volume of a sample's views, scaled to a mean density of the rays of
        about one before, so that a weight of its options is relative to the content.
        """
        assert isinstance(self.start, Mapping)
        case = views[sample : sample + 1]
        level = content_scale(case) / typical_chord(geometry.A.grid)
        within = {} if geometry.mask is None else {"support": geometry.mask[sample, 0]}
        return RECONSTRUCTORS.from_config(self.start, geometry.A, case / level, **within) * level


def normalised(
    geometry: Geometry,
    views: Float[Tensor, "b 1 m v u"],
    start: ClassicalStart,
    training: bool = False,
) -> tuple[Float[Tensor, "b 1 k v u"], Float[Tensor, "b 1 d h w"], Float[Tensor, "b 1 1 1 1"]]:
    """Views and their classical start, both divided by the content's scale, and that scale.

    The scale of views of nothing is zero.
    """
    x = start(geometry, views, training)
    scale = content_scale(x)
    return views / scale, x / scale, scale * anything(views)


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
    """One where views show anything, zero where they show nothing: f(0) = 0. NaN where a value is
    not finite, which `check_finite` does not tell of a GPU's views.
    """
    values = views.flatten(1)
    shown = values.any(dim=1).to(views.dtype)
    finite = values.isfinite().all(dim=1)
    return torch.where(finite, shown, torch.nan).reshape(-1, 1, 1, 1, 1)
