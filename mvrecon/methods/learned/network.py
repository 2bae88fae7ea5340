"""Networks on volumes by name, for methods: mvrecon's own, and those of plugins.

A network is built as `Network(inputs, outputs, **options)` and maps volumes [n inputs d h w] to
[n outputs d h w] of the same size. Its attribute `multiple`, where it has one, is the number of
voxels that must divide its sizes.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn.functional import pad

from mvrecon.core.parts import NETWORKS
from mvrecon.methods.learned.unet import PlainUNet, Precision


class UNet3d(PlainUNet):
    """The U-Net of mvrecon's own models as a network by name.

    Args:
        inputs, outputs: channels.
        widths: channels of each scale, the finest first.
        precision: of the convolutions.
    """

    def __init__(
        self,
        inputs: int,
        outputs: int,
        widths: Sequence[int] = (16, 32, 64),
        precision: Precision = "float32",
    ):
        super().__init__(3, inputs, outputs, widths, precision=precision)


def network_by_name(
    config: Mapping[str, Any], inputs: int, outputs: int, zero: int = 0
) -> nn.Module:
    """A network for a method, built by name and made to fit volumes of any size.

    Args:
        config: `{"name": ..., **options}`.
        inputs: channels in.
        outputs: channels out.
        zero: so many of the first outputs start at exactly zero.

    Raises:
        LookupError: an unknown name.
        TypeError: a description without a name, an unknown option, or a part that is no module.
    """
    network = NETWORKS.from_config(config, inputs, outputs)
    if not isinstance(network, nn.Module):
        raise TypeError(
            f"A network must be a torch.nn.Module, got {type(network).__name__} from {config}"
        )
    return SizedNetwork(network, outputs, zero)


class SizedNetwork(nn.Module):
    """A network made to fit a method: volumes of any size, and a start at zero.

    Sizes that the network does not take are padded with zeros behind, and its answer is cropped.
    Every output has a learned factor, zero or one in the beginning (ReZero, Bachlechner and others,
    UAI 2021).

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

    def forward(self, x: Float[Tensor, "n i d h w"]) -> Float[Tensor, "n o d h w"]:
        d, h, w = x.shape[2:]
        multiple = getattr(self.network, "multiple", 1)
        behind = [-size % multiple for size in (w, h, d)]
        padded = pad(x, [amount for axis in behind for amount in (0, axis)]) if any(behind) else x
        answer = self.network(padded)
        self._check(answer, padded)
        return self.factor * answer[..., :d, :h, :w]

    def _check(self, answer: object, x: Tensor) -> None:
        expected = (len(x), len(self.factor), *x.shape[2:])
        got = tuple(answer.shape) if isinstance(answer, Tensor) else type(answer).__name__
        if got != expected:
            raise ValueError(
                f"Expected the network {type(self.network).__name__} to keep the size of its "
                f"volumes and give a tensor {expected}, got {got}"
            )
