"""What the cross-view model is compared with: the plain mean, a single world U-Net, and methods
without training.
"""

from collections.abc import Mapping
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn

from mvrecon.models.consistency import Consistency, Steps
from mvrecon.models.cropping import Cropping
from mvrecon.models.door import admitted
from mvrecon.models.geometry import Geometry
from mvrecon.models.network import network_by_name
from mvrecon.models.options import Options
from mvrecon.models.output import Reconstruction
from mvrecon.models.single_pass import SinglePass
from mvrecon.models.start import (
    ClassicalStart,
    Start,
    anything,
    content_scale,
    normalised,
    typical_chord,
)
from mvrecon.projectors.checks import check_views
from mvrecon.projectors.operator import Projector
from mvrecon.reconstructors.iterative import SirtWeights, correction, sirt, sirt_weights


class MeanFusion(SinglePass):
    """The mean of the M cameras' networks, as first proposed: no weighting, no refinement.

    Args:
        projector, head, opinion, start, consistency, options: as in `SinglePass`.

    Raises:
        ValueError: `refine_where`, since nothing is refined.
    """

    def __init__(
        self,
        projector: Projector,
        head: Mapping[str, Any],
        opinion: Mapping[str, Any] | None = None,
        start: Start = 12,
        consistency: Steps = 3,
        **options: Any,
    ):
        super().__init__(
            projector,
            head,
            opinion,
            fusion="mean",
            refine=0,
            start=start,
            consistency=consistency,
            **options,
        )
        _refuse_where(self.options)


class BackprojectionUNet(nn.Module):
    """One 3-D U-Net in the world on the summed back-projection and a few SIRT iterations, then
    consistency steps.

    Args:
        projector: holds the grid and the rig.
        width: channels of the finest level, where the options name no network.
        start: iterations of SIRT with momentum, the classical start, or a reconstructor as `{name:
            ..., **options}`.
        consistency: learned gradient steps towards the data at the end, or `{steps: ..., noise:
            poisson}` for counts.
        options: of `Options`: what is left out (support, masked, ...), nothing by default, and the
            network.

    Raises:
        ValueError: `refine_where`, since no opinions could disagree.
    """

    def __init__(
        self,
        projector: Projector,
        width: int = 18,
        start: Start = 12,
        consistency: Steps = 3,
        **options: Any,
    ):
        super().__init__()
        self.options = Options.of(type(self), options)
        _refuse_where(self.options)
        self.cropping = Cropping(projector, self.options)
        steps = Consistency(consistency)
        self.start = ClassicalStart(start, counts=steps.poisson)
        self.net = network_by_name(self.options.network, 3, 1, width, zero=1)
        self.consistency = steps

    def forward(self, views: Float[Tensor, "b 1 m v u"]) -> Reconstruction:
        views = admitted(views, self.cropping.cameras, self.consistency.lengths)
        return self.cropping(views, self.reconstruct)

    def reconstruct(self, views: Float[Tensor, "b 1 m v u"], geometry: Geometry) -> Reconstruction:
        """The volume on a geometry: the whole grid's, or a crop's."""
        y, x0, scale = normalised(geometry, views, self.start, self.training)
        evidence = torch.cat([x0, geometry.back(y), geometry.residual(x0, y)], dim=1)
        volume = x0 + geometry.within(self.net(evidence, geometry.network_mask))
        sigma = None if self.options.sigma is None else self.options.sigma / scale
        volume = self.consistency(geometry, volume, y, sigma)
        return Reconstruction(volume * scale, support=geometry.mask, start=x0 * scale)


def _refuse_where(options: Options) -> None:
    if options.refine_where != "all":
        raise ValueError(
            f"refine_where={options.refine_where!r} needs opinions and their refinement, as in "
            f"'single_pass'"
        )


class GeometryFree(nn.Module):
    """A U-Net that is told nothing of the cameras: M views as channels, each repeated along depth
    in its own frame.

    It is what `BackprojectionUNet` would be without known geometry; the rig serves only for the
    views' scale.

    Args:
        projector: holds the grid and the rig.
        width: channels of the finest level, where no network is named.
        network: by name, `{"name": ..., **options}`; none for `UNet3d`.
    """

    def __init__(
        self, projector: Projector, width: int = 18, network: Mapping[str, Any] | None = None
    ):
        super().__init__()
        self.projector = projector
        self.chord = typical_chord(projector.grid)
        self.net = network_by_name(network, len(projector.cameras), 1, width)

    def forward(self, views: Float[Tensor, "b 1 m v u"]) -> Reconstruction:
        views = admitted(views, self.projector.cameras, next(self.net.parameters()))
        views = views.contiguous()  # other strides are rounded in another order
        scale = content_scale(views) / self.chord
        depth, *across = self.projector.grid.shape
        flat = nn.functional.interpolate(
            (views / scale)[:, 0] / self.chord, size=across, mode="bilinear"
        )
        volume = self.net(flat[:, :, None].expand(-1, -1, depth, -1, -1))
        return Reconstruction(volume=volume * scale * anything(views))


class Sirt(nn.Module):
    """SIRT with non-negativity; nothing to train.

    Args:
        projector: holds the grid and the rig.
        iterations: how many.
    """

    def __init__(self, projector: Projector, iterations: int = 50):
        super().__init__()
        self.projector = projector
        self.iterations = iterations

    def forward(self, views: Float[Tensor, "b 1 m v u"]) -> Reconstruction:
        check_views(views, self.projector.cameras)
        return Reconstruction(volume=sirt(self.projector, views, self.iterations))


class Backprojection(nn.Module):
    """The summed back-projection, each ray's mean density spread along it; nothing to train.

    Args:
        projector: holds the grid and the rig.
    """

    row: Tensor
    column: Tensor

    def __init__(self, projector: Projector):
        super().__init__()
        self.projector = projector
        row, column = sirt_weights(projector)
        self.register_buffer("row", row, persistent=False)
        self.register_buffer("column", column, persistent=False)

    def forward(self, views: Float[Tensor, "b 1 m v u"]) -> Reconstruction:
        check_views(views, self.projector.cameras)
        weights = SirtWeights(self.row, self.column)
        return Reconstruction(correction(self.projector, views, weights))
