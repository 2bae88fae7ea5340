"""Several pinholes on one detector: their images add up."""

from jaxtyping import Float
from torch import Tensor

from mvrecon.operators.operator import Composed, LinearOperator
from mvrecon.operators.selection import ViewSelection


class SummedHoles(LinearOperator):
    """The sum of the images of n pinholes in turn, views [b c m*n v u] to [b c m v u].

    Raises:
        ValueError: a number of views that n does not divide.
    """

    def __init__(self, shape: tuple[int, ...], holes: int):
        count, *pixels = shape
        if holes < 1 or count % holes:
            raise ValueError(f"Expected {holes} pinholes on every detector, got {count} in all")
        self.holes, self.domain_shape = holes, tuple(shape)
        self.range_shape = (count // holes, *pixels)

    def forward(self, x: Float[Tensor, "b c n v u"]) -> Float[Tensor, "b c m v u"]:
        return x.unflatten(2, (-1, self.holes)).sum(dim=3)

    def adjoint(self, y: Float[Tensor, "b c m v u"]) -> Float[Tensor, "b c n v u"]:
        return y.repeat_interleave(self.holes, dim=2)


class Multiplexed(Composed):
    """Counts [b c m v u] of m detectors on which the images of n pinholes add up.

    Args:
        A: the projector of all m * n pinholes, those of a detector in turn, with the same pixels.
        holes: n.

    Raises:
        ValueError: a number of pinholes that n does not divide.
    """

    def __init__(self, A: LinearOperator, holes: int):
        super().__init__(SummedHoles(A.range_shape, holes), A)
        self.holes = holes

    def subset(self, selection: LinearOperator) -> LinearOperator:
        """The views of some detectors by their own pinholes; some pixels by all of their views."""
        if not isinstance(selection, ViewSelection):
            return super().subset(selection)
        views = [view * self.holes + hole for view in selection.views for hole in range(self.holes)]
        return Multiplexed(self.B.subset(ViewSelection(self.B.range_shape, views)), self.holes)
