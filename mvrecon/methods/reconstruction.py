"""The result of a method, and of the alignment of its views."""

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, NamedTuple, Self

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import adaptive_avg_pool3d

from mvrecon.core.numbers import divided


class Prior(NamedTuple):
    """Standard deviations of a camera's errors that are to be expected.

    Args:
        shift_px: along each axis, in pixels.
        gain: relative.
    """

    shift_px: float = 1.0
    gain: float = 0.05


#: A pixel and 5 %.
USUAL = Prior()


@dataclass(frozen=True, eq=False)
class Alignment:
    """What is wrong with each view, and how well it is known.

    Args:
        shift_px: of the detector along its columns' and its rows' direction (u, v), in pixels.
        gain: factor of the view's values; 0: the view is lost.
        shift_error: standard error of the shifts, in pixels.
        gain_error: standard error of the gains.
    """

    shift_px: Float[Tensor, "b m 2"]
    gain: Float[Tensor, "b m"]
    shift_error: Float[Tensor, "b m 2"]
    gain_error: Float[Tensor, "b m"]

    @classmethod
    def none(cls, views: Float[Tensor, "b 1 m v u"]) -> "Alignment":
        """Cameras as they should be, without an error."""
        zero = views.new_zeros(len(views), views.shape[2])
        pair = zero[..., None].expand(-1, -1, 2)
        return cls(pair, zero + 1, pair, zero)

    @classmethod
    def joined(cls, parts: Sequence["Alignment"]) -> "Alignment":
        """The alignments of batches, one behind the other."""
        columns = zip(*(one.tensors() for one in parts), strict=True)
        return cls(*(torch.cat(same) for same in columns))

    def split(self) -> list["Alignment"]:
        """The alignment of each sample of the batch."""
        columns = (value.split(1) for value in self.tensors())
        return [Alignment(*parts) for parts in zip(*columns, strict=True)]

    def to(self, *where: Any) -> "Alignment":
        """On another device, or in another type."""
        return Alignment(*(value.to(*where) for value in self.tensors()))

    def tensors(self) -> list[Tensor]:
        """Shifts, gains, and the errors of both."""
        return [getattr(self, field.name) for field in fields(self)]

    def deviation(self, prior: Prior = USUAL) -> Float[Tensor, "b m"]:
        """How wrong each camera is, without a unit: shift and gain relative to what is to be
        expected.
        """
        shift = (self.shift_px / prior.shift_px).square().sum(dim=-1)
        return (shift + ((self.gain - 1) / prior.gain).square()).sqrt()


@dataclass
class Reconstruction:
    """A reconstructed volume, and what else its method reports.

    Per-view quantities have the resolution of the method's frusta, in cells of voxels or pixels.

    Args:
        volume: in the unit of (views / mm).
        per_view: each camera's own estimate of the volume.
        visible: voxels inside each camera's frustum.
        weights: of each camera at each voxel; they sum to one over the cameras that see it.
        predictions: what the estimates of all other cameras predict of each camera's view, in the
            unit of the views.
        sigma: standard deviation of the error of each voxel, in the unit of the volume.
        support: voxels that may differ from zero; None: all.
        start: the classical reconstruction that a network began with.
        entry: the volume that enters expectation maximisation, which hides its scale and its
            negative values.
        alignment: shift and gain of each camera, of views that were aligned before.
    """

    volume: Float[Tensor, "b 1 d h w"]
    per_view: Float[Tensor, "b m 1 d h w"] | None = None
    visible: Bool[Tensor, "m 1 d h w"] | None = None
    weights: Float[Tensor, "b m 1 d h w"] | None = None
    predictions: Float[Tensor, "b 1 m v u"] | None = None
    sigma: Float[Tensor, "b 1 d h w"] | None = None
    support: Bool[Tensor, "b 1 d h w"] | None = None
    start: Float[Tensor, "b 1 d h w"] | None = None
    entry: Float[Tensor, "b 1 d h w"] | None = None
    alignment: Alignment | None = None

    def split(self) -> list[Self]:
        """The reconstruction of each case of the batch."""
        count = len(self.volume)

        def case(value: Any, i: int) -> Any:
            if isinstance(value, Alignment):
                return value.split()[i]
            return value[i : i + 1] if isinstance(value, Tensor) and len(value) == count else value

        own = [field.name for field in fields(self) if field.name != "visible"]  # of all cases
        return [
            replace(self, **{name: case(getattr(self, name), i) for name in own})
            for i in range(count)
        ]

    @property
    def camera_weights(self) -> Float[Tensor, "b m"] | None:
        """The density-weighted mean of each camera's weights over the volume; they sum to one. None
        without weights.
        """
        if self.weights is None:
            return None
        d, h, w = self.weights.shape[-3:]
        density = adaptive_avg_pool3d(self.volume.clamp_min(0), (d, h, w))
        sums = (self.weights * density[:, None]).flatten(2).sum(dim=2)
        return divided(sums, sums.sum(dim=1, keepdim=True))
