"""The model in rounds, each at its own resolution; `docs/model.md` tells the design."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from mvrecon.geometry.box import Box, bounds
from mvrecon.models.consistency import Consistency, Steps
from mvrecon.models.cropping import Cropping
from mvrecon.models.cross_view.settings import ROUNDS, Computing, RoundOptions
from mvrecon.models.cross_view.step import Measured, Round, State
from mvrecon.models.cross_view.uncertainty import Uncertainty
from mvrecon.models.cross_view.views import among_counts
from mvrecon.models.door import admitted
from mvrecon.models.geometry import Geometry
from mvrecon.models.options import Options
from mvrecon.models.output import Reconstruction
from mvrecon.models.start import ClassicalStart, Start, normalised
from mvrecon.projectors.operator import Projector

#: Voxels around a support that networks see, and of whose multiples their boxes have bounds: cells
#: and coarser voxels keep their places for networks of three scales.
MARGIN, ALIGNED = 4, 8


class CrossView(nn.Module):
    """Reconstruction in rounds: cameras correct their views, a network in the world changes the
    volume, in the unit of (views / mm).

    From SIRT with momentum in the support each round adds to x what its networks make of the
    residual views y + e - A x, where e is what the cameras have corrected; then come data
    consistency with the corrected views, and non-negativity. Everything is divided by the
    content's scale, f(a y) = a f(y). With Poisson noise pixels that are empty as most about them
    are not corrected: what a network adds there comes back as activity beside the object.

    Args:
        projector: its grid and its rig.
        rounds: options of each round: `{resolution, widths, cameras, opinions}`.
        start: iterations of SIRT with momentum, the classical start, or a reconstructor as `{name:
            ..., **options}`, whose volumes are kept in training.
        consistency: learned gradient steps towards the corrected views at the end, or `{steps: ...,
            noise: poisson}` for counts.
        support: where the density may differ from zero, from the views: the visual "hull", its
            "box", "auto", or "none" for the whole grid.
        noise: of the views, as `support_from_views` wants it; none for exact views.
        computing: of `Computing`: precision and crop of the networks, and uncertainty.

    Raises:
        TypeError: an option that a round or the model does not have.
        ValueError: no round, an unknown support or precision, a crop without a support, or cameras'
            networks whose memories do not fit one another.
    """

    def __init__(
        self,
        projector: Projector,
        rounds: Sequence[Mapping[str, Any]] = ROUNDS,
        start: Start = 12,
        consistency: Steps = 2,
        support: str = "none",
        noise: Mapping[str, Any] | None = None,
        **computing: Any,
    ):
        super().__init__()
        if not rounds:
            raise ValueError("Expected at least one round, got none")
        how = Computing.of(computing)
        options = [RoundOptions.of(one) for one in rounds]
        first = next((i for i, one in enumerate(options) if one.corrects), len(options))
        self.cropping = Cropping(projector, Options(support=support, noise=noise))
        if how.crop and support == "none":
            raise ValueError("Expected a support to crop to, got crop=True and support='none'")
        steps = Consistency(consistency)
        self.crop, self.start = how.crop, ClassicalStart(start, counts=steps.poisson)
        self.rounds = nn.ModuleList(
            Round(projector, one, first < i, how.precision) for i, one in enumerate(options)
        )
        self.trust = nn.Parameter(torch.ones(())) if first < len(options) else None
        self.consistency = steps
        self.uncertainty = Uncertainty(how.precision) if how.uncertainty else None
        self._check_memories()

    def _check_memories(self) -> None:
        networks: list[Any] = [one.cameras for one in self.rounds if one.cameras is not None]
        shapes = {tuple(network.memory_shape) for network in networks}
        if len(shapes) > 1:
            raise ValueError(
                f"Expected cameras' networks of equal binning and memory, got memories "
                f"{sorted(shapes)}"
            )

    def forward(self, views: Float[Tensor, "b 1 m v u"]) -> Reconstruction:
        views = admitted(views, self.cropping.cameras, self.consistency.lengths)
        geometry = self._geometry(views)
        y, x0, scale = normalised(geometry, views, self.start, self.training)
        correctable = geometry.row > 0
        if self.consistency.poisson:
            correctable = correctable & among_counts(views)
        chord = torch.where(correctable, 1 / geometry.row, 0)
        boxes = boxes_of(geometry.mask) if self.crop and geometry.mask is not None else None
        measured, state = Measured(geometry, y, chord, boxes), State(x0, torch.zeros_like(x0))
        volumes, corrected, before = [], [], x0
        for one in self.rounds:
            before, state = state.volume, one(measured, state)
            volumes.append(state.volume * scale)
            if one.corrects:
                corrected.append((y + chord * state.correction) * scale)
        if state.correction is not None and self.trust is not None:
            y = y + self.trust * chord * state.correction
        trusted = geometry
        if state.ray_weights is not None and not self.consistency.poisson:
            trusted = replace(geometry, row=geometry.row * state.ray_weights)
        volume = self.consistency(trusted, state.volume, y).clamp_min(0)
        sigma = None
        if self.uncertainty is not None:
            sigma = self.uncertainty(geometry, y, volume, (x0, before)) * scale
        return Reconstruction(
            volume * scale,
            sigma=sigma,
            support=geometry.mask,
            start=x0 * scale,
            earlier=tuple(volumes[:-1]),
            entry=volumes[-1] if self.consistency.em else None,
            corrected_views=tuple(corrected),
            row=geometry.row if corrected else None,
            **_opinions(state, scale),
        )

    def _geometry(self, views: Float[Tensor, "b 1 m v u"]) -> Geometry:
        """The whole grid's, within the support: R from the rays' chords of it, none very short, C
        zero outside.
        """
        geometry = self.cropping.whole
        if self.cropping.options.support != "none":
            geometry = geometry.with_mask(self.cropping.mask(views), masked=False)
        return replace(geometry, row=geometry.bounded_row)


def _opinions(state: State, scale: Float[Tensor, "b 1 1 1 1"]) -> dict[str, Any]:
    """The last opinions of the cameras, in the unit of (views / mm)."""
    fused = state.fused
    if fused is None:
        return {}
    return {
        "opinions": fused.opinions * scale[:, None],
        "visible": fused.visible,
        "weights": fused.weights,
        "cross_views": fused.expected * scale,
    }


def boxes_of(mask: Bool[Tensor, "b 1 d h w"]) -> list[Box]:
    """The box around each sample's mask, with its margin and bounds that the networks divide; of
    none, the whole grid.
    """
    shape = mask.shape[2:]
    boxes = [Box.of(numbers) for numbers in bounds(mask[:, 0]).tolist()]
    boxes = [box.grown(MARGIN, shape).aligned(ALIGNED, shape) for box in boxes]
    return [box if box.size else Box.whole(shape) for box in boxes]
