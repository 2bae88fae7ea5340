"""Group normalisation and SiLU in plain torch, with the derivative written out.

Of a channel, z = (x - mean) per scale + shift, where per = 1 / sqrt(variance + eps), and the answer
is z / (1 + exp(-z)). Sums are float64, and so is what is made of them.
"""

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from mvrecon.kernels.precision import wide


def plain(
    x: Float[Tensor, "n c *d"],
    scale: Float[Tensor, " c"],
    shift: Float[Tensor, " c"],
    groups: int,
    eps: float,
) -> Float[Tensor, "n c *d"]:
    """SiLU of torch's own group normalisation, which takes derivatives of any order."""
    x = wide(x)
    return F.silu(torch.group_norm(x, groups, scale.to(x), shift.to(x), eps))


def sums_of(x: Float[Tensor, "n c *d"], by: Tensor | None = None) -> Float[Tensor, "n 2 c"]:
    """Sums over the places: of values and their products with `by`, by default with themselves."""
    values = x.double().flatten(2)
    products = values * (values if by is None else by.double().flatten(2))
    return torch.stack((values.sum(dim=2), products.sum(dim=2)), dim=1)


def standardised(
    x: Float[Tensor, "n c *d"], sums: Float[Tensor, "n 2 c"], groups: int, eps: float
) -> tuple[Float[Tensor, "n c *d"], Float[Tensor, "n c *l"]]:
    """(x - mean) per in float64, and per."""
    ones = [1] * (x.ndim - 2)
    mean, square = averaged(sums, x, groups).unbind(dim=1)
    per = ((square - mean.square()).clamp(min=0) + eps).rsqrt().reshape(*mean.shape, *ones)
    return (x.double() - mean.reshape(*mean.shape, *ones)) * per, per


def averaged(
    sums: Float[Tensor, "n 2 c"], x: Float[Tensor, "n c *d"], groups: int
) -> Float[Tensor, "n 2 c"]:
    """The mean over a group's values, for each of its channels."""
    among = sums.unflatten(2, (groups, -1))
    count = among.shape[3] * max(1, x.shape[2:].numel())
    return (among.sum(dim=3, keepdim=True) / count).expand_as(among).flatten(2)


def normalised(
    x: Float[Tensor, "n c *d"],
    scale: Float[Tensor, " c"],
    shift: Float[Tensor, " c"],
    groups: int,
    eps: float,
) -> tuple[Float[Tensor, "n c *d"], Float[Tensor, "n 2 c"]]:
    """The answer, and the sums of the features and of their squares."""
    sums = sums_of(x)
    normal, _ = standardised(x, sums, groups, eps)
    answer = F.silu(normal * along(scale, x) + along(shift, x))
    return channels_last(answer.to(wide(x).dtype)), sums


def change(
    x: Float[Tensor, "n c *d"],
    answer: Float[Tensor, "n c *d"],
    scale: Float[Tensor, " c"],
    shift: Float[Tensor, " c"],
    sums: Float[Tensor, "n 2 c"],
    groups: int,
    eps: float,
) -> tuple[Float[Tensor, "n c *d"], Float[Tensor, "n 2 c"]]:
    """The change of the features by that of the answer, and of an item's shift and scale."""
    normal, per = standardised(x, sums, groups, eps)
    z = normal * along(scale, x) + along(shift, x)
    part = z.sigmoid()
    before = answer.double() * part * (1 + z * (1 - part))
    back = sums_of(before, normal)
    even, tilt = averaged(back * scale.double(), x, groups).unbind(dim=1)
    ones = [1] * (x.ndim - 2)
    even, tilt = (one.reshape(*one.shape, *ones) for one in (even, tilt))
    result = per * (before * along(scale, x) - even - normal * tilt)
    return channels_last(result.to(wide(x).dtype)), back


def along(numbers: Float[Tensor, " c"], x: Float[Tensor, "n c *d"]) -> Float[Tensor, "c *l"]:
    """Numbers of channels in float64, to be multiplied with features."""
    return numbers.double().reshape(-1, *[1] * (x.ndim - 2))


def channels_last(x: Float[Tensor, "n c *d"]) -> Float[Tensor, "n c *d"]:
    """The same numbers with channels last in memory, for any number of axes."""
    return x.movedim(1, -1).contiguous().movedim(-1, 1)
