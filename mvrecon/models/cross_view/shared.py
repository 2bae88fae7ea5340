"""One network for all cameras, or one for each."""

from collections.abc import Callable

import torch
from jaxtyping import Float
from torch import Tensor, nn


class OneEach(nn.Module):
    """M networks, called as one on the images or volumes of all cameras, camera by camera within
    each sample.

    Args:
        count: of the cameras, M.
        make: makes one network.
    """

    def __init__(self, count: int, make: Callable[[], nn.Module]):
        super().__init__()
        self.networks = nn.ModuleList(make() for _ in range(count))

    def forward(self, x: Float[Tensor, "n i *d"]) -> Float[Tensor, "n o *d"]:
        parts = x.unflatten(0, (-1, len(self.networks))).unbind(1)
        pairs = zip(self.networks, parts, strict=True)
        return torch.stack([network(part) for network, part in pairs], dim=1).flatten(0, 1)


def for_cameras(shared: bool, count: int, make: Callable[[], nn.Module]) -> nn.Module:
    """One network for all cameras, or one for each of so many."""
    return make() if shared else OneEach(count, make)
