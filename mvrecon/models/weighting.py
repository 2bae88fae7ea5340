"""Fusion: how much each camera's opinion counts at each voxel."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from mvrecon.models.masks import halved, pooled, upsampled
from mvrecon.models.unet3d import UNet3d


def fuse(
    volumes: Float[Tensor, "b m 1 d h w"], logits: Float[Tensor, "b m 1 d h w"], visible: Tensor
) -> tuple[Float[Tensor, "b 1 d h w"], Float[Tensor, "b m 1 d h w"]]:
    """The weighted mean over the cameras that see a voxel, and its weights; zero where none does.

    Zero logits give the plain mean. The result is equivariant to a permutation of the cameras.
    """
    # Finite, not -inf: a voxel that no camera sees must not turn into NaN.
    weights = torch.where(visible, logits, torch.finfo(logits.dtype).min).softmax(dim=1) * visible
    return (weights * volumes).sum(dim=1), weights


class Weighting(nn.Module):
    """A U-Net that gives one logit per voxel and camera from the features of that camera, the same for all cameras.

    It works at half the grid's resolution: confidence varies more slowly than density, and at full resolution it would
    cost as much as everything else together.

    Args:
        inputs: feature channels of one camera.
        width: channels of the finest level.
    """

    def __init__(self, inputs: int, width: int = 8):
        super().__init__()
        self.net = UNet3d(inputs, 1, width, levels=2, zero=True)

    def forward(
        self,
        features: Float[Tensor, "b m c d h w"],
        mask: Bool[Tensor, "b 1 d h w"] | None = None,
        bricks: str = "never",
    ) -> Float[Tensor, "b m 1 d h w"]:
        """Logits; with a mask, from its voxels alone and zero outside it."""
        b, m = features.shape[:2]
        if mask is not None:
            return self._masked(features.flatten(0, 1), mask.repeat_interleave(m, dim=0), bricks).unflatten(0, (b, m))
        coarse = halved(features.flatten(0, 1))
        logits = nn.functional.interpolate(self.net(coarse), size=features.shape[-3:], mode="trilinear")
        return logits.unflatten(0, (b, m))

    def _masked(self, features: Tensor, mask: Tensor, bricks: str) -> Tensor:
        fine = mask.to(features.dtype)
        coarse, held = pooled(features * fine, fine)
        logits = self.net(coarse, held > 0, bricks)
        return upsampled(logits, held, fine, [2 * n for n in held.shape[2:]])
