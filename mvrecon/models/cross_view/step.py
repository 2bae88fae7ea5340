"""One round: residual views, the cameras' corrections and opinions, the network in the world."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor, nn

from mvrecon.geometry.box import Box, placed
from mvrecon.models.cross_view.cells import from_cells, padded, to_cells, trimmed
from mvrecon.models.cross_view.evidence import MAGNIFIED, Answer, Evidence
from mvrecon.models.cross_view.opinions import Fused, Opinions
from mvrecon.models.cross_view.settings import RoundOptions
from mvrecon.models.cross_view.unet import PlainUNet, Precision
from mvrecon.models.geometry import Geometry
from mvrecon.parts import CAMERA_NETWORKS
from mvrecon.projectors.operator import Projector
from mvrecon.projectors.pixel_integral import sees_integrals


class State(NamedTuple):
    """What one round hands on to the next.

    Args:
        volume: x, relative to the content's scale.
        memory: a volume of the networks in the world, zero in the beginning.
        correction: R e, what the cameras have corrected so far, as mean densities along rays; none
            before any camera has.
        camera_memory: of the cameras' networks.
        fused: the last opinions of cameras.
    """

    volume: Float[Tensor, "b 1 d h w"]
    memory: Float[Tensor, "b 1 d h w"]
    correction: Float[Tensor, "b 1 m v u"] | None = None
    camera_memory: Float[Tensor, "b m k r s"] | None = None
    fused: Fused | None = None

    @property
    def ray_weights(self) -> Float[Tensor, "b 1 m v u"] | None:
        """How much the residual of each ray counts; none where all count as one."""
        return None if self.fused is None else self.fused.ray_weights


def _weighed(state: State, residual: Float[Tensor, "b 1 m v u"]) -> Float[Tensor, "b 1 m v u"]:
    """Residual views, each ray by its weight."""
    return residual if state.ray_weights is None else state.ray_weights * residual


class Measured(NamedTuple):
    """The views of a case and the geometry they belong to.

    Args:
        geometry: the operator and SIRT's weights; C is zero outside the support.
        views: y, relative to the content's scale.
        chord: 1 / R in mm, zero where R is, and where views are not corrected.
        boxes: of each sample, what the networks in the world see; none for the whole grid.
    """

    geometry: Geometry
    views: Float[Tensor, "b 1 m v u"]
    chord: Float[Tensor, "#b 1 m v u"]
    boxes: Sequence[Box] | None = None


class Round(nn.Module):
    """Round of the model: x + H (change + step C A^T R (y + trust e - A x)), in the unit of x.

    What opinions come to is evidence for the network in the world: further channels where they have
    the round's resolution, else features that are added at the scale that has their voxels.

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
                options.network, projector, options.task, precision=precision
            )
        self.corrects = options.corrects
        self.trust = nn.Parameter(torch.ones(())) if corrected or self.corrects else None
        self.step = nn.Parameter(torch.ones(()))
        self.scale, self.entry = options.scale, None
        self.of_lines = sees_integrals(projector)
        self.opinions = self._opinions(projector, options, precision, self.cameras)
        extra = 0 if options.judged is None else 2 + options.judged.handed
        cells, beside = self.edge**3, 0 if self.scale else extra
        self.world = PlainUNet(
            3, 4 * cells + beside, 2 * cells, options.widths, zero=cells, precision=precision
        )
        # before training a round with opinions is the round without
        if self.scale:
            self.entry = nn.Conv3d(extra, options.widths[self.scale], 1, bias=False)
            nn.init.zeros_(self.entry.weight)
        elif extra:
            nn.init.zeros_(self.world.first.weight[:, -extra:])

    @staticmethod
    def _opinions(
        projector: Projector, options: RoundOptions, precision: Precision, network: Any
    ) -> Opinions | None:
        if options.judged is None:
            return None
        return Opinions(
            projector,
            options.judged,
            options.edge << options.scale,
            network.binning,
            network.depths,
            precision,
        )

    def forward(self, measured: Measured, state: State) -> State:
        """The state after the round."""
        geometry, x = measured.geometry, state.volume
        projected = geometry.A(x)
        residual = measured.views - projected
        if state.correction is not None:
            residual = residual + self._views(measured, state.correction)
        change = geometry.back(_weighed(state, residual))
        extra: list[Tensor] = []
        if self.cameras is not None:
            state, answer = self._asked(measured, state, residual, change)
            if answer.correction is not None:
                residual = residual + self._views(measured, answer.correction)
            if self.opinions is not None:
                sums = None if self.of_lines else geometry.bounded_sums
                # detached: a correction's task is the operator's view, not that an opinion be good
                missed = residual.detach()
                fused = self.opinions(x, missed, projected, answer.placed, geometry.mask, sums)
                state, extra = state._replace(fused=fused), [fused.evidence]
            change = geometry.back(_weighed(state, residual))
        learned, memory = self._world(measured, state, change, extra)
        x = x + geometry.within(learned + self.step * change)
        return state._replace(volume=x, memory=memory)

    def _views(
        self, measured: Measured, correction: Float[Tensor, "b 1 m v u"]
    ) -> Float[Tensor, "b 1 m v u"]:
        """What a correction adds to the views, as far as the round trusts it."""
        assert self.trust is not None  # where a camera corrects, here or before
        return self.trust * measured.chord * correction

    def _asked(
        self,
        measured: Measured,
        state: State,
        residual: Float[Tensor, "b 1 m v u"],
        change: Float[Tensor, "b 1 d h w"],
    ) -> tuple[State, Answer]:
        """The state with this round's corrections in it, and the cameras' answer."""
        row, memory = measured.geometry.row, state.camera_memory
        if memory is None:
            memory = row.new_zeros(len(residual), *self.cameras.memory_shape)
        evidence = Evidence(row * measured.views, row * residual, state.volume, change, memory)
        answer = self.cameras(evidence)
        state = state._replace(camera_memory=answer.memory)
        if answer.correction is None:
            return state, answer
        added = answer.correction * (row > 0)
        total = added if state.correction is None else state.correction + added
        return state._replace(correction=total), answer._replace(correction=added)

    def _world(
        self,
        measured: Measured,
        state: State,
        change: Float[Tensor, "b 1 d h w"],
        extra: list[Tensor],
    ) -> tuple[Float[Tensor, "b 1 d h w"], Float[Tensor, "b 1 d h w"]]:
        x, mask = state.volume, measured.geometry.mask
        hull = torch.ones_like(x) if mask is None else mask.to(x.dtype)
        evidence = torch.cat([x, MAGNIFIED * change, hull, state.memory], dim=1)
        if measured.boxes is None:
            return self._answer(evidence, extra)
        volumes = []
        for i, box in enumerate(measured.boxes):
            edge = self.edge << self.scale
            cells = [slice(s.start // edge, -(-s.stop // edge)) for s in box.slices]
            part = [one[i : i + 1, :, *cells] for one in extra]
            answer = self._answer(evidence[i : i + 1, :, *box.slices], part)
            volumes.append(placed(torch.cat(answer, dim=1), box, x.shape[2:]))
        learned, memory = torch.cat(volumes).split(1, dim=1)
        return learned, memory

    def _answer(
        self, evidence: Float[Tensor, "b 4 d h w"], extra: list[Tensor]
    ) -> tuple[Float[Tensor, "b 1 d h w"], Float[Tensor, "b 1 d h w"]]:
        """The change that the network in the world has learned, and its memory.

        Args:
            evidence: volumes.
            extra: what opinions come to, in their cells already.
        """
        cells = to_cells(padded(evidence, self.edge), self.edge)
        if self.entry is not None:
            answer = self.world(cells, {self.scale: self.entry(*extra)})
        else:
            answer = self.world(torch.cat([cells, *extra], dim=1) if extra else cells)
        volumes = trimmed(from_cells(answer, self.edge), evidence.shape[2:])
        learned, memory = volumes.split(1, dim=1)
        return learned, memory
