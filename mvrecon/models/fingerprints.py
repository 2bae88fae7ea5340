"""Names of cases, by which a training knows what it has computed of them before."""

import hashlib

from jaxtyping import Float
from torch import Tensor


def fingerprints(views: Float[Tensor, "b 1 m v u"]) -> list[bytes]:
    """A name for each sample's views, the same where all bits are; a GPU is waited for once."""
    return [hashlib.sha256(case.numpy().tobytes()).digest() for case in views.detach().cpu()]
