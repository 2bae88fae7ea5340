"""A masked network by its definition: whole volumes, set to zero outside the mask after every
step.
"""

import torch
import torch.nn.functional as F
from mvrecon.models.networks import ConvBlock, UNet3d, upsampled
from torch import Tensor


def pooled(x: Tensor, mask: Tensor) -> tuple[Tensor, Tensor]:
    """Means of 2x2x2 voxels over those in the mask, and the max-pooled mask."""
    share = F.avg_pool3d(mask, 2, ceil_mode=True)
    some = (share > 0).to(x.dtype)
    return F.avg_pool3d(x * mask, 2, ceil_mode=True) / torch.where(share > 0, share, 1.0), some


def normalised(x: Tensor, mask: Tensor, norm: torch.nn.GroupNorm) -> Tensor:
    """Sample by sample and group by group."""
    size, samples = x.shape[1] // norm.num_groups, []
    for n in range(len(x)):
        inside, groups = mask[n, 0] > 0, []
        for group in x[n].split(size):
            held = group[:, inside]
            spread = held.var(unbiased=False) if held.numel() else held.sum()
            groups.append(
                (group - (held.mean() if held.numel() else 0)) / (spread + norm.eps).sqrt()
            )
        affine = (
            torch.cat(groups) * norm.weight[:, None, None, None] + norm.bias[:, None, None, None]
        )
        samples.append(affine * mask[n])
    return torch.stack(samples)


def block_on(block: ConvBlock, x: Tensor, mask: Tensor) -> Tensor:
    for k, (conv, norm, act) in enumerate((block.first, block.second)):
        y = act(normalised(F.conv3d(x, conv.weight, padding=1), mask, norm))
        x = x + y if k else y
    return x


def net_on(net: UNet3d, x: Tensor, mask: Tensor) -> Tensor:
    masks, skips = [mask.to(x.dtype)], []
    x = x * masks[0]
    for level, block in enumerate(net.down):
        if level:
            skips.append(x)
            x, held = pooled(x, masks[-1])
            masks.append(held)
        x = block_on(block, x, masks[level])
    for level in reversed(range(len(net.up))):
        whole = [2 * n for n in x.shape[2:]]
        x = upsampled(net.reduce[level](x), masks[level + 1], masks[level], whole)
        x = block_on(net.up[level], x + skips[level], masks[level])
    return net.last(x) * masks[0]
