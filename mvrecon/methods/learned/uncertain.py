"""A network around any method that estimates the standard deviation of each voxel's error."""

from dataclasses import replace
from math import log

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn.functional import softplus

from mvrecon.core.parts import MethodPart
from mvrecon.methods.learned.cross_view import RESIDUAL_GAIN
from mvrecon.methods.learned.geometry import Geometry, validated
from mvrecon.methods.learned.start import content_scale
from mvrecon.methods.learned.unet import PlainUNet, Precision, from_cells, padded, to_cells, trimmed
from mvrecon.methods.method import Reconstruction, build_method
from mvrecon.operators.operator import Projector

#: Voxels of the network's cells along each axis, and channels of its scales.
CELL_EDGE, CHANNELS = 2, (16, 32)
#: Initial and least standard deviation, relative to the intensity scale.
INITIAL_SIGMA, MIN_SIGMA = 0.1, 1e-3


class Uncertain(nn.Module):
    """A method with a network that estimates the standard deviation of its error.

    The network's input is the volume, its change from the method's start, and the residual views:
    their mean and root mean square over the rays of each voxel. No gradient flows back into the
    method (Stirn et al., Faithful Heteroscedastic Regression with Neural Networks, AISTATS 2023;
    Seitzer et al., ICLR 2022, show how a shared network suffers).

    Args:
        method: name and options of the method.
        precision: precision of the convolutions.
    """

    def __init__(self, method: MethodPart, precision: Precision = "auto"):
        super().__init__()
        self.method = build_method(method)
        cells = CELL_EDGE**3
        self.network = PlainUNet(3, 5 * cells, cells, CHANNELS, cells, precision)

    def forward(self, views: Float[Tensor, "b 1 m v u"], A: Projector) -> Reconstruction:
        out = self.method(views, A)
        y = validated(views, A, self.network.first.weight)
        with torch.no_grad():
            volume = out.volume.to(y.dtype)
            scale = content_scale(volume)
            x, r = volume / scale, (y - A(volume)) / scale
            g = Geometry.of(A, y.dtype, out.support)
            start = x if out.start is None else out.start / scale
            power = g.direction(g.row * r.square()).clamp_min(0)
            small = RESIDUAL_GAIN * torch.cat([x - start, g.direction(r), power.sqrt()], dim=1)
            where = torch.ones_like(x) if g.support is None else g.support.to(x)
            inputs = torch.cat([x, small, where], dim=1)
        cells = to_cells(padded(inputs, CELL_EDGE), CELL_EDGE)
        answer = trimmed(from_cells(self.network(cells), CELL_EDGE), x.shape[2:])
        # not exp, which does not recover from too long a step
        sigma = g.within(MIN_SIGMA + INITIAL_SIGMA / log(2) * softplus(answer))
        return replace(out, sigma=sigma * scale)
