"""Several pinholes per detector, with overlapping images."""

from jaxtyping import Float
from torch import Tensor, nn

from mvrecon.geometry.cameras.camera import Cameras
from mvrecon.operators.operator import Derived, LinearOperator
from mvrecon.operators.selection import ViewSelection


class Multiplexed(nn.Module, Derived):
    """Counts [b c m v u] of m detectors, each the sum of the images of n pinholes.

    Args:
        A: projector of all m * n pinholes, grouped by detector, with the same pixels.
        holes: number n of pinholes per detector.

    Raises:
        ValueError: the number of pinholes is not a multiple of n, or consecutive ones have
            detectors at different places.
    """

    def __init__(self, A: LinearOperator, holes: int):
        super().__init__()
        count, *pixels = A.range_shape
        if holes < 1 or count % holes:
            raise ValueError(f"Expected {holes} pinholes on every detector, got {count} in all")
        self.A, self.holes = A, holes
        self.domain_shape, self.range_shape = A.domain_shape, (count // holes, *pixels)
        rig: Cameras | None = getattr(A, "cameras", None)  # single bins have none
        if rig is None:
            return
        centres = rig.detector_centre.detach().unflatten(0, (-1, holes))
        apart = (centres - centres[:, :1]).norm(dim=-1)
        if apart.max() > rig.u.norm(dim=1).max():
            view = int(apart.flatten().argmax())
            raise ValueError(
                f"Expected {holes} consecutive pinholes with one detector, got that of pinhole "
                f"{view} {apart.max():.3g} mm from that of {view - view % holes}"
            )

    def forward(self, x: Float[Tensor, "b c d h w"]) -> Float[Tensor, "b c m v u"]:
        return self.A(x).unflatten(2, (-1, self.holes)).sum(dim=3)

    def adjoint(self, y: Float[Tensor, "b c m v u"]) -> Float[Tensor, "b c d h w"]:
        return self.A.adjoint(y.repeat_interleave(self.holes, dim=2))

    def mu_map(self) -> Float[Tensor, "d h w"] | None:
        """A's."""
        return self.A.mu_map()

    def subset(self, selection: LinearOperator) -> LinearOperator:
        """Operator of a subset of detectors with their pinholes; subsets of pixels are computed
        from full views.
        """
        if not isinstance(selection, ViewSelection):
            return super().subset(selection)
        views = [view * self.holes + hole for view in selection.views for hole in range(self.holes)]
        return Multiplexed(self.A.subset(ViewSelection(self.A.range_shape, views)), self.holes)
