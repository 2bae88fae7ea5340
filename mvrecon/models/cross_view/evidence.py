"""What a cameras' network looks at, and what it promises.

It is built as `Network(projector, task, precision=..., **options)`, says in `memory_shape` the size
of its memory of one sample, (cameras, channels, rows, columns), and in `binning` and `depths` how
its frusta are cut: detector pixels joined along each axis, and bins along a ray. It maps `Evidence`
to the `Answer` that its `Task` asks for.
"""

from typing import NamedTuple

from jaxtyping import Float
from torch import Tensor

#: By which residuals, small beside the views, enter the networks; and what they make of a view is
#: small likewise.
MAGNIFIED, SMALL = 8.0, 0.1


class Task(NamedTuple):
    """What a round asks of its cameras' network.

    Args:
        correct: whether it corrects the views.
        shared: one network for all cameras, or one for each.
        logits: channels in the frusta that are zero in the beginning.
        features: channels in the frusta behind them.
    """

    correct: bool = True
    shared: bool = True
    logits: int = 0
    features: int = 0


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


class Answer(NamedTuple):
    """What a cameras' network makes of its evidence.

    Args:
        memory: for the cameras' network of a later round.
        correction: R e of every view, as mean densities along rays; none where none is asked for.
        placed: logits and features in the frusta of the cameras; none where none are asked for.
    """

    memory: Float[Tensor, "b m k r s"]
    correction: Float[Tensor, "b 1 m v u"] | None = None
    placed: Float[Tensor, "b m c D r s"] | None = None
