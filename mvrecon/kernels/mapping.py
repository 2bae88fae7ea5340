"""How `torch.func.vmap` maps the compiled operators."""

from collections.abc import Callable

import torch
from torch import Tensor

Mapped = Callable[..., tuple[Tensor, int]]


def batched(operator: Callable[..., Tensor]) -> Mapped:
    """How `torch.func.vmap` maps operator(values, geometry, ..): values join its batch, geometries
    are looped over.
    """

    def mapped(info, in_dims, values, geometry, *rest):
        where, of_geometry = in_dims[:2]
        if of_geometry is None:
            moved = values.movedim(where, 0)
            return operator(moved.flatten(0, 1), geometry, *rest).unflatten(0, moved.shape[:2]), 0
        copies = values.unbind(where) if where is not None else [values] * info.batch_size
        pairs = zip(copies, geometry.unbind(of_geometry), strict=True)
        return torch.stack([operator(*pair, *rest) for pair in pairs]), 0

    return mapped


def looped(operator: Callable[..., Tensor], tensors: int) -> Mapped:
    """How `torch.func.vmap` maps an operator whose result sums over the batch: one call each."""

    def mapped(info, in_dims, *inputs):
        copies = [
            tensor.unbind(dim) if dim is not None else [tensor] * info.batch_size
            for tensor, dim in zip(inputs[:tensors], in_dims, strict=False)
        ]
        return torch.stack(
            [operator(*one, *inputs[tensors:]) for one in zip(*copies, strict=True)]
        ), 0

    return mapped


def joined(operator: Callable[..., Tensor]) -> Callable[..., tuple[Tensor, None]]:
    """How `torch.func.vmap` maps what is asked of all volumes at once, for the first of the
    geometries.
    """

    def mapped(info, in_dims, values, geometry, *rest):
        where, of_geometry = in_dims[:2]
        every = values if where is None else values.movedim(where, 0).flatten(0, 1)
        first = geometry if of_geometry is None else geometry.select(of_geometry, 0)
        return operator(every, first, *rest), None

    return mapped
