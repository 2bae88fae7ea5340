"""Where tensors lie."""

from torch import Tensor


def beside(tensor: Tensor, like: Tensor) -> Tensor:
    """A tensor in the type and the place of another; the host does not wait for a GPU's copy."""
    return tensor.to(like, non_blocking=not like.is_cpu)
