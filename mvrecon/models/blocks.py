"""Convolution blocks shared by the networks."""

from math import gcd

from jaxtyping import Float
from torch import Tensor, nn


class ConvBlock(nn.Module):
    """Two 3x3x3 convolutions, each followed by group normalisation and SiLU, with a residual path around the second."""

    def __init__(self, inputs: int, outputs: int, groups: int = 4):
        super().__init__()
        groups = gcd(groups, outputs)
        self.first = nn.Sequential(
            nn.Conv3d(inputs, outputs, 3, padding=1, bias=False), nn.GroupNorm(groups, outputs), nn.SiLU()
        )
        self.second = nn.Sequential(
            nn.Conv3d(outputs, outputs, 3, padding=1, bias=False), nn.GroupNorm(groups, outputs), nn.SiLU()
        )

    def forward(self, x: Float[Tensor, "n i d h w"]) -> Float[Tensor, "n o d h w"]:
        x = self.first(x)
        return x + self.second(x)
