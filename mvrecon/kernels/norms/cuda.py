"""Group normalisation and SiLU on CUDA devices, with channels last in memory; the same to the last
bit in every run.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from mvrecon.kernels.cuda.driver import BLOCK
from mvrecon.kernels.cuda.launch import Layer, Variant, start
from mvrecon.kernels.precision import arithmetic

#: Threads at most, as many as fill a device, and values of one at least, of which it leaves two.
THREADS, RUN = 2**17, 16


def part_of(stored: Tensor) -> Variant:
    """The kernels that read features as they are stored; they write in the type of arithmetic."""
    return Variant("norm", arithmetic(stored.dtype), stored.dtype)


def normalised(
    x: Float[Tensor, "n c *d"],
    scale: Float[Tensor, " c"],
    shift: Float[Tensor, " c"],
    groups: int,
    eps: float,
) -> tuple[Float[Tensor, "n c *d"], Float[Tensor, "n 2 c"]]:
    """As `reference.normalised`: two kernels, and a sum of their sums."""
    features, part = rows_of(x), part_of(x)
    factors, terms = (one.detach().to(part.real).contiguous() for one in (scale, shift))
    layer = layer_of(features, groups, eps).put(features=features, scale=factors, shift=terms)
    sums = summed(part, "sum_features", layer, features)
    answer = torch.empty_like(features, dtype=part.real)
    start(part, "normalise", layer.put(sums=sums, result=answer), features, all_blocks(layer, x))
    return answer.movedim(-1, 1), sums


def change(
    x: Float[Tensor, "n c *d"],
    answer: Float[Tensor, "n c *d"],
    scale: Float[Tensor, " c"],
    shift: Float[Tensor, " c"],
    sums: Float[Tensor, "n 2 c"],
    groups: int,
    eps: float,
) -> tuple[Float[Tensor, "n c *d"], Float[Tensor, "n 2 c"]]:
    """As `reference.change`: two kernels, and a sum of their sums."""
    features, part = rows_of(x), part_of(x)
    by = rows_of(answer).to(part.real)
    factors, terms = (one.detach().to(part.real).contiguous() for one in (scale, shift))
    layer = layer_of(features, groups, eps).put(
        features=features, change=by, scale=factors, shift=terms, sums=sums
    )
    back = summed(part, "sum_changes", layer, features)
    result = torch.empty_like(by)
    layer.put(back=back, result=result)
    start(part, "change_features", layer, features, all_blocks(layer, x))
    return result.movedim(-1, 1), back


def rows_of(x: Float[Tensor, "n c *d"]) -> Float[Tensor, "n *d c"]:
    """Features as rows of channels: no copy where channels are last in memory."""
    return x.detach().movedim(1, -1).contiguous()


def layer_of(features: Float[Tensor, "n *d c"], groups: int, eps: float) -> Layer:
    """The sizes of a call."""
    items, channels = len(features), features.shape[-1]
    values = features[:1].numel()
    rows = min(-(-values // channels // RUN), max(1, THREADS // max(1, items * channels)))
    sizes = {"channels": channels, "group": channels // groups, "values": values}
    return Layer().put(**sizes, rows=rows, blocks=-(-rows * channels // BLOCK), eps=eps)


def all_blocks(layer: Layer, x: Tensor) -> int:
    """Blocks of all items."""
    return len(x) * layer.blocks


def summed(
    part: Variant, name: str, layer: Layer, features: Float[Tensor, "n *d c"]
) -> Float[Tensor, "n 2 c"]:
    """The two sums of each item's channels, first of each thread's values, in float64."""
    size = len(features), layer.rows, 2, layer.channels
    sums = torch.empty(size, dtype=torch.float64, device=features.device)
    start(part, name, layer.put(result=sums), features, all_blocks(layer, features))
    return sums.sum(dim=1)
