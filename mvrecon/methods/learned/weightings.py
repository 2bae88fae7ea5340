"""Weighting networks: map the comparison of each camera's estimate with the others' to the logits
of the cameras' weights in `cross_view`.

A weighting network is built with its number of input channels and called with inputs [b m c e i x],
which hold the `CHANNELS` of each of m cameras on the grid of the per-view estimates, and with the
cells that each camera sees, `visible` [m 1 e i x]. It returns logits [b m 1 e i x]; the weights of
a cell are their softmax over the cameras that see it. Any number of cameras and cells is possible,
and logits follow their cameras: in another order of the cameras they are the same in that order.
Logits that are equal for all cameras before training make an untrained `cross_view` SIRT.
"""

from collections.abc import Sequence

from jaxtyping import Bool, Float
from torch import Tensor

from mvrecon.methods.learned.unet import PlainUNet, Precision

#: Input channels of a weighting network, all relative to the content's scale; the first four are
#: multiplied by 8, as changes are small relative to the volume.
CHANNELS = (
    "change",  # of the volume, by the camera's own view
    "others",  # mean of the other cameras' changes
    "deviation",  # standard deviation of the other cameras' changes
    "unexplained",  # residual that the others' mean leaves in the camera's view, spread along rays
    "volume",  # the start
    "confidence",  # logit of the depth network; absent without one
)


class UNetWeighting(PlainUNet):
    """A 3-D U-Net on the channels of each camera, with the same parameters for all cameras.

    Its logits are zero before training.

    Args:
        inputs: channels of a camera.
        widths: channels of each scale, the finest first.
        precision: precision of the convolutions.

    Raises:
        ValueError: no scales.
    """

    def __init__(
        self, inputs: int, widths: Sequence[int] = (16, 32), precision: Precision = "auto"
    ):
        if not widths:
            raise ValueError(
                f"widths (weight_widths of cross_view): expected at least one scale, got {widths}"
            )
        super().__init__(3, inputs, 1, widths, zero=1, precision=precision)
        self.last.bias = None  # no effect: the same for all cameras

    def forward(
        self, inputs: Float[Tensor, "b m c e i x"], visible: Bool[Tensor, "m 1 e i x"]
    ) -> Float[Tensor, "b m 1 e i x"]:
        return super().forward(inputs.flatten(0, 1)).unflatten(0, inputs.shape[:2])
