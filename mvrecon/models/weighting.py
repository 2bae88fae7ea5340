"""Fusion: how much each camera's opinion counts at each voxel."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from mvrecon.models import sparse
from mvrecon.models.geometry import Geometry
from mvrecon.models.networks import UNet3d, halved
from mvrecon.models.pooling import deviation, pooled
from mvrecon.models.sparse import pyramid


def fuse(
    volumes: Float[Tensor, "b m 1 d h w"], logits: Float[Tensor, "b m 1 d h w"], visible: Tensor
) -> tuple[Float[Tensor, "b 1 d h w"], Float[Tensor, "b m 1 d h w"]]:
    """The weighted mean over the cameras that see a voxel, and its weights; zero where none does.

    Zero logits give the plain mean. The result is equivariant to a permutation of the cameras.
    """
    # Finite, not -inf: a voxel that no camera sees must not turn into NaN.
    weights = torch.where(visible, logits, torch.finfo(logits.dtype).min).softmax(dim=1) * visible
    return (weights * volumes).sum(dim=1), weights


def comparison(
    geometry: Geometry,
    opinions: Float[Tensor, "b m 1 d h w"],
    start: Float[Tensor, "b 1 d h w"],
    residual: Float[Tensor, "b m m v u"],
) -> Float[Tensor, "b m 5 d h w"]:
    """What `Weighting` gets of each camera: its opinion, that one's back-projected residual, the
    mean and the deviation of all opinions, and the start.

    Args:
        geometry: of the volumes.
        opinions: each camera's volume.
        start: a classical reconstruction.
        residual: the views less each camera's opinion as all cameras would have seen it.
    """
    mean, variance = pooled(opinions, geometry.fine.visible)
    with torch.no_grad():  # a hint for the weights; its gradient costs more than it teaches
        disagreement = geometry.back(residual)[:, :, None]
    common = torch.cat([mean, deviation(variance), start[:, None]], dim=2)
    common = common.expand(-1, opinions.shape[1], -1, -1, -1, -1)
    return torch.cat([opinions, disagreement, common], dim=2)


class Weighting(nn.Module):
    """A U-Net that gives one logit per voxel and camera from the features of that camera, the same
    for all cameras.

    It works at half the grid's resolution: confidence varies more slowly than density, and at full
    resolution it would cost as much as everything else together.

    Args:
        inputs: feature channels of one camera.
        width: channels of the finest level.
    """

    def __init__(self, inputs: int, width: int = 8):
        super().__init__()
        self.net = UNet3d(inputs, 1, width, levels=2)
        nn.init.zeros_(self.net.last.weight)  # start from the plain mean

    def forward(
        self, features: Float[Tensor, "b m c d h w"], mask: Bool[Tensor, "b 1 d h w"] | None = None
    ) -> Float[Tensor, "b m 1 d h w"]:
        """Logits; with a mask, from its voxels alone and zero outside it."""
        if mask is not None:
            return self._on(features, mask)
        logits = self.net(halved(features.flatten(0, 1)))
        whole = nn.functional.interpolate(logits, size=features.shape[-3:], mode="trilinear")
        return whole.unflatten(0, features.shape[:2])

    def _on(self, features: Tensor, mask: Tensor) -> Float[Tensor, "b m 1 d h w"]:
        m = features.shape[1]
        fine, coarse = pyramid(mask, 2)
        rows = sparse.halved(
            fine.pick(features.flatten(1, 2)), fine, coarse
        )  # of all cameras, side by side
        per_camera = [
            part.unflatten(1, (m, -1)).transpose(0, 1).flatten(0, 1)
            for part in rows.split(coarse.counts)
        ]
        levels = pyramid(coarse.mask.repeat_interleave(m, dim=0), len(self.net.down))
        logits = self.net.on(levels, torch.cat(per_camera)).split(
            [m * count for count in coarse.counts]
        )
        side_by_side = torch.cat([part.view(m, -1).T for part in logits])
        return fine.put(sparse.doubled(side_by_side, coarse, fine))[:, :, None]
