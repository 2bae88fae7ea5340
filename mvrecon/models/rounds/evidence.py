"""What a cameras' network looks at, and what it promises.

It is built as `Network(projector, precision=..., **options)`, says in `memory_shape` the size of
its memory of one sample, (cameras, channels, rows, columns), and maps `Evidence` to the correction
R e of every view [b 1 m v u] and its new memory.
"""

from typing import NamedTuple

from jaxtyping import Float
from torch import Tensor

#: By which residuals, small beside the views, enter the networks; and what they make of a view is
#: small likewise.
MAGNIFIED, SMALL = 8.0, 0.1


class Evidence(NamedTuple):
    """What a cameras' network looks at; all values are densities relative to the content's.

    Args:
        measured: R y, each view as the mean density along its rays.
        residual: R (y + e - A x).
        volume: x.
        change: C A^T R (y + e - A x).
        memory: of the cameras' network of an earlier round, zero in the first.
    """

    measured: Float[Tensor, "b 1 m v u"]
    residual: Float[Tensor, "b 1 m v u"]
    volume: Float[Tensor, "b 1 d h w"]
    change: Float[Tensor, "b 1 d h w"]
    memory: Float[Tensor, "b m k r s"]
