"""The three schools of sparse-view reconstruction by networks and filtered back-projection.

X. Liang, Y. Yang, L. Xing, "Comparison of projection domain, image domain, and comprehensive deep
learning for sparse-view X-ray CT image reconstruction", arXiv 1804.04289 (2018).
"""

from collections.abc import Mapping
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn.functional import pad

from mvrecon.cameras.camera import Cameras
from mvrecon.models.door import admitted
from mvrecon.models.output import Reconstruction
from mvrecon.models.sparse_view.angles import AngularUpsampling
from mvrecon.models.sparse_view.filtered import (
    Geometry,
    corrector,
    filtered,
    in_full_precision,
    scaled,
    sinograms,
)
from mvrecon.models.start import typical_chord
from mvrecon.projectors.operator import Projector
from mvrecon.reconstructors.filtered.filters import Filter
from mvrecon.reconstructors.filtered.scan_weights import scan_of

#: Views that a sinogram of a whole turn is continued by at both ends, for its network.
WRAP = 8


class SinogramCompletion(nn.Module):
    """Sinogram completion interpolates views in angle and corrects all of them by a network, in the
    views' unit.

    The network takes a detector row's sinogram for a slice, with a second channel that is one at
    measured views. The sinogram of a whole turn goes on at its ends.

    Args:
        geometry: grid and measured rig.
        factor: views for one measured view.
        network: name and options; None: `unet2d`.

    Raises:
        ValueError: sources that are not on a circle, or a factor below one.
    """

    measured: Tensor

    def __init__(self, geometry: Geometry, factor: int, network: Mapping[str, Any] | None):
        super().__init__()
        self.upsampling = AngularUpsampling.of(geometry.cameras, geometry.grid, factor)
        self.geometry = Geometry(geometry.grid, self.upsampling.cameras)
        self.chord = typical_chord(geometry.grid)
        self.net = corrector(network, 2)
        measured = torch.arange(len(self.geometry.cameras)) % factor == 0
        self.register_buffer("measured", measured, persistent=False)

    def forward(self, views: Float[Tensor, "b 1 m v u"]) -> Float[Tensor, "b 1 n v u"]:
        """Sinograms of all angles from those of the measured ones."""
        dense = self.upsampling(views)
        rows = sinograms(dense) / self.chord
        known = self.measured.to(rows)[:, None].expand_as(rows)
        evidence = torch.cat([rows, known], dim=1)
        wrap = min(WRAP, len(self.measured)) if self.upsampling.closed else 0
        if wrap:
            evidence = pad(evidence, (0, 0, wrap, wrap, 0, 0), mode="circular")
        change = self.net(evidence)[..., wrap : wrap + len(self.measured), :]
        return dense + self.chord * sinograms(change)


class _School(nn.Module):
    """Filtered back-projection with a network before it, behind it, or both."""

    #: Only rigs whose sources lie on a circle are taken.
    needs_circle = True
    #: The rig whose views the sinogram network makes; none without that network.
    corrected_cameras: Cameras | None = None

    def __init__(self, projector: Projector, filter: Filter):
        super().__init__()
        scan_of(projector.cameras, projector.grid)  # refuses other rigs
        self.projector = projector
        self.filter: Filter = filter
        self.completion: SinogramCompletion | None = None
        self.net: nn.Module | None = None

    def _completed(self, factor: int, network: Mapping[str, Any] | None) -> None:
        geometry = Geometry(self.projector.grid, self.projector.cameras)
        self.completion = SinogramCompletion(geometry, factor, network)
        self.corrected_cameras = self.completion.geometry.cameras

    def forward(self, views: Float[Tensor, "b 1 m v u"]) -> Reconstruction:
        views = admitted(views, self.projector.cameras, next(self.parameters()))
        with in_full_precision(views):
            y, start, scale = scaled(self.projector, views, self.filter)
            x, corrected = start, {}
            if self.completion is not None:
                sinogram = self.completion(y)
                x = filtered(self.completion.geometry, sinogram, self.filter)
                row = scale.new_full((1, 1, 1, 1, 1), 1 / self.completion.chord)
                corrected = {"corrected_views": (sinogram * scale,), "row": row}
            if self.net is not None:
                x = x + self.net(x)
        return Reconstruction(x * scale, start=start * scale, **corrected)


class FbpUNet(_School):
    """Image domain: filtered back-projection, then a network that takes its streaks away.

    Slices of fans and parallel beams by FBP, cones by FDK (Jin and others, IEEE Trans. Image
    Process. 26, 2017).

    Args:
        projector: holds the grid and the rig.
        network: name and options of the network on slices; None: `unet2d`.
        filter: window of the ramp, as in `fbp`.

    Raises:
        ValueError: a rig that filtered back-projection does not take.
    """

    def __init__(
        self,
        projector: Projector,
        network: Mapping[str, Any] | None = None,
        filter: Filter = "ram-lak",
    ):
        super().__init__(projector, filter)
        self.net = corrector(network, 1)


class SinogramUNet(_School):
    """Projection domain: sinograms interpolated in angle, corrected by a network, then filtered
    back-projection.

    It is trained end to end through the back-projection on the volume's error, and on the completed
    sinogram's with the loss term `corrected_views`; on that alone with `volume: 0`, as published.

    Args:
        projector: holds the grid and the rig.
        factor: views for one measured view.
        network: name and options of the network on sinograms; None: `unet2d`.
        filter: window of the ramp, as in `fbp`.

    Raises:
        ValueError: a rig that filtered back-projection does not take, or a factor below one.
    """

    def __init__(
        self,
        projector: Projector,
        factor: int = 4,
        network: Mapping[str, Any] | None = None,
        filter: Filter = "ram-lak",
    ):
        super().__init__(projector, filter)
        self._completed(factor, network)


class DualDomain(_School):
    """Both domains, end to end: sinogram network, filtered back-projection, image network.

    Args:
        projector: holds the grid and the rig.
        factor: views for one measured view.
        sinogram_network: name and options of the network on sinograms; None: `unet2d`.
        network: name and options of the network on slices; None: `unet2d`.
        filter: window of the ramp, as in `fbp`.

    Raises:
        ValueError: a rig that filtered back-projection does not take, or a factor below one.
    """

    def __init__(
        self,
        projector: Projector,
        factor: int = 4,
        sinogram_network: Mapping[str, Any] | None = None,
        network: Mapping[str, Any] | None = None,
        filter: Filter = "ram-lak",
    ):
        super().__init__(projector, filter)
        self._completed(factor, sinogram_network)
        self.net = corrector(network, 1)
