"""A model's networks by name: mvrecon's own, those of the literature, and a plugin's.

A network is built as `Network(inputs, outputs, **options)` and maps volumes [n inputs d h w] to
[n outputs d h w] of the same size. It may say two things of itself, by class or by instance:
`takes_mask`, that it is called as `network(x, mask)` and answers zero outside the mask; `multiple`,
that it takes sizes only which so many voxels divide.
"""

from collections.abc import Mapping
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn
from torch.nn.functional import pad

from mvrecon.models.networks import UNet3d
from mvrecon.models.unet2d import UNet2d
from mvrecon.parts import NETWORKS


def network_by_name(
    config: Mapping[str, Any] | None, inputs: int, outputs: int, width: int, zero: int = 0
) -> nn.Module:
    """Network that a model calls as `network(x, mask)`, built by name.

    Args:
        config: `{"name": ..., **options}`; none for mvrecon's own, `UNet3d`, of so many channels.
        inputs: channels in.
        outputs: channels out.
        width: channels of the finest level of the network where no name is given.
        zero: so many of the first outputs start at exactly zero, as what only corrects does.

    Raises:
        LookupError: an unknown name.
        TypeError: a description without a name, an unknown option, or a part that is no module.
    """
    if config is None:
        network: Any = UNet3d(inputs, outputs, width)
    else:
        network = NETWORKS.from_config(config, inputs, outputs)
    if isinstance(network, UNet3d | UNet2d):
        nn.init.zeros_(network.last.weight[:zero])
        return network
    if not isinstance(network, nn.Module):
        raise TypeError(
            f"A network must be a torch.nn.Module, got {type(network).__name__} from {config}"
        )
    return SizedNetwork(network, outputs, zero)


class SizedNetwork(nn.Module):
    """A plugin's or a published network, made to fit a model: any size, a mask, and a start at
    zero.

    Sizes that the network does not take are padded with zeros behind, and its answer is cropped;
    its answer is set to zero outside a mask that it does not take. Every output has a learned
    factor, zero or one in the beginning (ReZero, Bachlechner and others, UAI 2021).

    Args:
        network: from volumes of some channels to volumes of others.
        outputs: channels out.
        zero: so many of the first outputs start at exactly zero.

    Raises:
        ValueError: the network's answer is no tensor of the input's size (at the call).
    """

    def __init__(self, network: nn.Module, outputs: int, zero: int = 0):
        super().__init__()
        self.network = network
        self.factor = nn.Parameter((torch.arange(outputs) >= zero).float().view(-1, 1, 1, 1))

    def forward(
        self, x: Float[Tensor, "n i d h w"], mask: Bool[Tensor, "n 1 d h w"] | None = None
    ) -> Float[Tensor, "n o d h w"]:
        """Answer; with a mask, zero outside it."""
        d, h, w = x.shape[2:]
        multiple = getattr(self.network, "multiple", 1)
        behind = [-size % multiple for size in (w, h, d)]
        padding = [amount for axis in behind for amount in (0, axis)]
        padded = pad(x, padding) if any(padding) else x
        if mask is not None and getattr(self.network, "takes_mask", False):
            answer = self.network(padded, pad(mask, padding))
        else:
            answer = self.network(padded)
        self._check(answer, padded)
        answer = self.factor * answer[..., :d, :h, :w]
        return answer if mask is None else answer * mask

    def _check(self, answer: object, x: Tensor) -> None:
        expected = (len(x), len(self.factor), *x.shape[2:])
        got = tuple(answer.shape) if isinstance(answer, Tensor) else type(answer).__name__
        if got != expected:
            raise ValueError(
                f"Expected the network {type(self.network).__name__} to give a tensor {expected} "
                f"for volumes {tuple(x.shape)}, got {got}; 'unet3d' needs padding 'same' in a model"
            )
