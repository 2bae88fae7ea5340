"""Networks and data-consistency steps in turn."""

from collections.abc import Mapping
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn

from mvrecon.models.door import admitted
from mvrecon.models.output import Reconstruction
from mvrecon.models.sparse_view.filtered import corrector, filtered, in_full_precision, scaled
from mvrecon.projectors.operator import Projector
from mvrecon.reconstructors.filtered.filters import Filter
from mvrecon.reconstructors.filtered.scan_weights import scan_of


class ItNet(nn.Module):
    """Iterations of a network and a filtered back-projection of the residual: x <- x + U(x), then
    x <- x + lambda_k FBP(y - A x).

    The first x is FBP(y), the last operation a step towards the data. The lengths lambda_k are
    learned, in units of 1 / growth, the greatest factor by which FBP A amplifies a volume: it is
    far above one where views are few, since filtered back-projection then overshoots near the axis.
    The network hands a few channels on to its next call (Genzel, Guehring, Macdonald
    and Maerz, Near-exact recovery for tomographic inverse problems via deep learning, ICML 2022).

    Args:
        projector: A, which holds the grid and the rig.
        iterations: of network and step.
        memory: channels from one call of the network to the next.
        shared: one network for all iterations, or one each.
        network: name and options of the network on slices; None: `unet2d`.
        filter: window of the ramp, as in `fbp`.

    Raises:
        ValueError: no iteration, or a rig that filtered back-projection does not take.
    """

    #: Only rigs whose sources lie on a circle are taken.
    needs_circle = True

    def __init__(
        self,
        projector: Projector,
        iterations: int = 4,
        memory: int = 5,
        shared: bool = True,
        network: Mapping[str, Any] | None = None,
        filter: Filter = "ram-lak",
    ):
        super().__init__()
        if iterations < 1 or memory < 0:
            raise ValueError(
                f"Expected at least one iteration and no fewer than 0 channels of memory, got "
                f"iterations {iterations}, memory {memory}"
            )
        scan_of(projector.cameras, projector.grid)  # refuses other rigs
        self.projector, self.memory = projector, memory
        self.filter: Filter = filter
        self.growth = growth(projector, filter)
        self.lengths = nn.Parameter(torch.ones(iterations))
        self.nets = nn.ModuleList(
            corrector(network, 1 + memory, 1 + memory, zero=1)
            for _ in range(1 if shared else iterations)
        )

    def forward(self, views: Float[Tensor, "b 1 m v u"]) -> Reconstruction:
        views = admitted(views, self.projector.cameras, self.lengths)
        with in_full_precision(views):
            y, start, scale = scaled(self.projector, views, self.filter)
            x = start
            state = x.new_zeros(len(x), self.memory, *x.shape[2:])
            for number, length in enumerate(self.lengths):
                answer = self.nets[number % len(self.nets)](torch.cat([x, state], dim=1))
                x, state = x + answer[:, :1], answer[:, 1:]
                x = self.consistent(x, y, length)
        return Reconstruction(x * scale, start=start * scale)

    def consistent(
        self,
        volume: Float[Tensor, "b 1 d h w"],
        views: Float[Tensor, "b 1 m v u"],
        length: Float[Tensor, ""],
    ) -> Float[Tensor, "b 1 d h w"]:
        """A step towards the data, x + length / growth FBP(y - A x)."""
        residual = views - self.projector(volume)
        return volume + length / self.growth * filtered(self.projector, residual, self.filter)


@torch.no_grad()
def growth(A: Projector, filter: Filter = "ram-lak", iterations: int = 15) -> float:
    """The greatest factor by which FBP A amplifies a volume, without unit, by the power method; one
    where it is less.

    With steps of at most 2 / growth the iteration x <- x + step FBP(y - A x) stays bounded.
    """
    random = torch.Generator().manual_seed(0)
    x = torch.rand(1, 1, *A.domain_shape, generator=random).to(A.device)
    factor = torch.ones(())
    for _ in range(iterations):
        image = filtered(A, A(x), filter)
        factor = image.norm() / x.norm()
        if not factor > 0:  # views that show nothing of the grid
            break
        x = image / image.norm()
    return max(1.0, factor.item())
