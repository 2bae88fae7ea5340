"""One round: residual views, the cameras' corrections, and the network in the world."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor, nn

from mvrecon.geometry.box import Box, placed
from mvrecon.models.geometry import Geometry
from mvrecon.models.rounds.cells import from_cells, padded, to_cells, trimmed
from mvrecon.models.rounds.evidence import MAGNIFIED, Evidence
from mvrecon.models.rounds.settings import RoundOptions
from mvrecon.models.rounds.unet import PlainUNet, Precision
from mvrecon.parts import CAMERA_NETWORKS
from mvrecon.projectors.operator import Projector


class State(NamedTuple):
    """What one round hands on to the next.

    Args:
        volume: x, relative to the content's scale.
        memory: a volume of the networks in the world, zero in the beginning.
        correction: R e, what the cameras have corrected so far, as mean densities along rays; none
            before any camera has.
        camera_memory: of the cameras' networks.
    """

    volume: Float[Tensor, "b 1 d h w"]
    memory: Float[Tensor, "b 1 d h w"]
    correction: Float[Tensor, "b 1 m v u"] | None = None
    camera_memory: Float[Tensor, "b m k r s"] | None = None


class Measured(NamedTuple):
    """The views of a case and the geometry they belong to.

    Args:
        geometry: the operator and SIRT's weights; C is zero outside the support.
        views: y, relative to the content's scale.
        chord: 1 / R in mm, zero where R is.
        boxes: of each sample, what the networks in the world see; none for the whole grid.
    """

    geometry: Geometry
    views: Float[Tensor, "b 1 m v u"]
    chord: Float[Tensor, "#b 1 m v u"]
    boxes: Sequence[Box] | None = None


class Round(nn.Module):
    """Round of the model: x + H (change + step C A^T R (y + trust e - A x)), in the unit of x.

    Args:
        projector: its grid and its rig.
        options: of this round.
        corrected: whether the cameras of an earlier round have corrected views.
        precision: of the convolutions.
    """

    def __init__(
        self,
        projector: Projector,
        options: RoundOptions,
        corrected: bool,
        precision: Precision = "float32",
    ):
        super().__init__()
        self.edge = options.edge
        self.cameras: Any = None
        if options.cameras is not None:
            self.cameras = CAMERA_NETWORKS.from_config(
                options.cameras, projector, precision=precision
            )
        self.trust = nn.Parameter(torch.ones(())) if corrected or options.cameras else None
        self.step = nn.Parameter(torch.ones(()))
        cells = self.edge**3
        self.world = PlainUNet(
            3, 4 * cells, 2 * cells, options.widths, zero=cells, precision=precision
        )

    def forward(self, measured: Measured, state: State) -> State:
        """The state after the round."""
        geometry, x = measured.geometry, state.volume
        residual = measured.views - geometry.A(x)
        if state.correction is not None and self.trust is not None:
            residual = residual + self.trust * measured.chord * state.correction
        change = geometry.back(residual)
        if self.cameras is not None and self.trust is not None:
            state, added = self._corrected(measured, state, residual, change)
            change = change + geometry.back(self.trust * measured.chord * added)
        learned, memory = self._world(measured, state, change)
        x = x + geometry.within(learned + self.step * change)
        return state._replace(volume=x, memory=memory)

    def _corrected(
        self,
        measured: Measured,
        state: State,
        residual: Float[Tensor, "b 1 m v u"],
        change: Float[Tensor, "b 1 d h w"],
    ) -> tuple[State, Float[Tensor, "b 1 m v u"]]:
        """The state with this round's corrections in it, and these alone."""
        row, memory = measured.geometry.row, state.camera_memory
        if memory is None:
            memory = row.new_zeros(len(residual), *self.cameras.memory_shape)
        evidence = Evidence(row * measured.views, row * residual, state.volume, change, memory)
        added, memory = self.cameras(evidence)
        added = added * (row > 0)
        total = added if state.correction is None else state.correction + added
        return state._replace(correction=total, camera_memory=memory), added

    def _world(
        self, measured: Measured, state: State, change: Float[Tensor, "b 1 d h w"]
    ) -> tuple[Float[Tensor, "b 1 d h w"], Float[Tensor, "b 1 d h w"]]:
        x, mask = state.volume, measured.geometry.mask
        hull = torch.ones_like(x) if mask is None else mask.to(x.dtype)
        evidence = torch.cat([x, MAGNIFIED * change, hull, state.memory], dim=1)
        if measured.boxes is None:
            return self._answer(evidence)
        samples = zip(evidence.split(1), measured.boxes, strict=True)
        volumes = [
            placed(torch.cat(self._answer(one[..., *box.slices]), dim=1), box, x.shape[2:])
            for one, box in samples
        ]
        learned, memory = torch.cat(volumes).split(1, dim=1)
        return learned, memory

    def _answer(
        self, evidence: Float[Tensor, "b 4 d h w"]
    ) -> tuple[Float[Tensor, "b 1 d h w"], Float[Tensor, "b 1 d h w"]]:
        """The change that the network in the world has learned, and its memory."""
        answer = self.world(to_cells(padded(evidence, self.edge), self.edge))
        volumes = trimmed(from_cells(answer, self.edge), evidence.shape[2:])
        learned, memory = volumes.split(1, dim=1)
        return learned, memory
