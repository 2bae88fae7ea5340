"""Several measurements of one volume in one likelihood: photopeaks, gated frames, several rigs."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn

from mvrecon.geometry.cameras.camera import VECTORS, Cameras
from mvrecon.geometry.grid import Grid
from mvrecon.operators.operator import LinearOperator, Projector
from mvrecon.operators.selection import ViewSelection


class Stacked(Projector):
    """The views of several operators of one volume, [b c d h w] -> [b c m v u], the first's before
    the second's; a Poisson likelihood of all counts together weights them as their noise does.

    Photopeaks have an operator each, with its attenuation, response and photons per decay, as by
    `0.062 * Spect(...)`. Gated frames have the cameras `rig.moved(R, t)` of the inverse of their
    motion, which moves the attenuation with the activity.

    Subsets of views hold every operator's, so that ordered subsets have all photopeaks.

    Args:
        operators: operators on one grid and one device, with detectors of the same pixels.

    Raises:
        ValueError: no operator, or operators of different volumes, pixels or devices.
    """

    def __init__(self, operators: Sequence[LinearOperator]):
        super().__init__()
        self.operators: list[Any] = [*operators]
        for number, A in enumerate(operators):
            if isinstance(A, nn.Module):  # a subset of thin rays is none
                self.add_module(str(number), A)
        kinds = {(A.domain_shape, A.range_shape[1:], str(A.device)) for A in operators}
        if len(kinds) != 1:
            raise ValueError(
                f"Expected operators of one volume, one size of views and one device, got "
                f"{sorted(kinds)}"
            )
        self.counts = [A.range_shape[0] for A in operators]
        ((self.domain_shape, pixels, _),) = kinds
        self.range_shape = (sum(self.counts), *pixels)
        self.capabilities = frozenset.intersection(*(A.capabilities for A in operators))

    @property
    def emission(self) -> bool:
        return self.operators[0].emission

    @property
    def grid(self) -> Grid:
        return self.operators[0].grid

    @property
    def cameras(self) -> Cameras:
        return joined_cameras([A.cameras for A in self.operators])

    @property
    def device(self) -> torch.device:
        return self.operators[0].device

    @property
    def pose_gradient(self) -> bool:
        return any(A.pose_gradient for A in self.operators)

    def forward(self, x: Float[Tensor, "b c d h w"]) -> Float[Tensor, "b c m v u"]:
        return torch.cat([A(x) for A in self.operators], dim=2)

    def adjoint(self, y: Float[Tensor, "b c m v u"]) -> Float[Tensor, "b c d h w"]:
        parts = y.split(self.counts, dim=2)
        volumes = [A.adjoint(part) for A, part in zip(self.operators, parts, strict=True)]
        return torch.stack(volumes).sum(dim=0)

    def subset(self, selection: LinearOperator) -> LinearOperator:
        """Selected views in their order, each by its operator; others from whole views."""
        if not isinstance(selection, ViewSelection) or selection.views != sorted(selection.views):
            return super().subset(selection)
        chosen, first = [], 0
        for A, count in zip(self.operators, self.counts, strict=True):
            own = [view - first for view in selection.views if first <= view < first + count]
            first += count
            if own:
                chosen.append(A.subset(ViewSelection(A.range_shape, own)))
        return Stacked(chosen)


def joined_cameras(rigs: Sequence[Cameras]) -> Cameras:
    """The cameras of several rigs, one after the other."""
    vectors: Any = {name: torch.cat([getattr(rig, name) for rig in rigs]) for name in VECTORS}
    return replace(rigs[0], **vectors)
