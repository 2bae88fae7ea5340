"""How far a volume may be off: the standard deviation of each voxel's error."""

from collections.abc import Sequence
from math import log

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn.functional import softplus

from mvrecon.models.cross_view.cells import from_cells, padded, to_cells, trimmed
from mvrecon.models.cross_view.evidence import MAGNIFIED
from mvrecon.models.cross_view.unet import PlainUNet, Precision
from mvrecon.models.geometry import Geometry

#: Volumes that the network looks at.
EVIDENCE = 6
#: Voxels of its cells along each axis, and channels of its scales.
EDGE, WIDTHS = 2, (16, 32)
#: The standard deviation before training and the least one, relative to the content's scale.
USUAL, LEAST = 0.1, 1e-3


class Uncertainty(nn.Module):
    """Network in the world estimates the standard deviation of each voxel's error, relative to the
    content's scale.

    It looks at the volume, at what the rounds have changed, and at the residual views, whose mean
    and root mean square over the rays of a voxel tell where views disagree. No gradient goes back
    to any of these: the volume is trained as if nobody asked (Stirn et al., Faithful
    Heteroscedastic Regression with Neural Networks, AISTATS 2023; why a shared network suffers:
    Seitzer et al., ICLR 2022).

    Args:
        precision: of the convolutions.
    """

    def __init__(self, precision: Precision = "float32"):
        super().__init__()
        cells = EDGE**3
        self.network = PlainUNet(3, EVIDENCE * cells, cells, WIDTHS, cells, precision)

    def forward(
        self,
        geometry: Geometry,
        views: Float[Tensor, "b 1 m v u"],
        volume: Float[Tensor, "b 1 d h w"],
        before: Sequence[Float[Tensor, "b 1 d h w"]],
    ) -> Float[Tensor, "b 1 d h w"]:
        """The standard deviation of a volume's error; zero outside the support.

        Args:
            geometry: the operator, SIRT's weights and the mask.
            views: corrected, relative to the content's scale.
            volume: x, likewise.
            before: two earlier volumes, the start and that before the last round.
        """
        evidence = _evidence(geometry, views, volume, before)
        cells = to_cells(padded(evidence, EDGE), EDGE)
        answer = trimmed(from_cells(self.network(cells), EDGE), volume.shape[2:])
        # not exp: a step that is too long would end at values that it does not come back from
        return geometry.within(LEAST + USUAL / log(2) * softplus(answer))


@torch.no_grad()
def _evidence(
    geometry: Geometry, views: Tensor, volume: Tensor, before: Sequence[Tensor]
) -> Float[Tensor, "b 6 d h w"]:
    residual = views - geometry.A(volume)
    power = geometry.back(geometry.row * residual.square()).clamp_min(0)
    changes = [volume - earlier for earlier in before]
    small = torch.cat([*changes, geometry.back(residual), power.sqrt()], dim=1)
    where = torch.ones_like(volume) if geometry.mask is None else geometry.mask.to(volume)
    return torch.cat([volume, MAGNIFIED * small, where], dim=1)
