"""Training losses, all relative to the data's value range so that one set of weights serves every unit."""

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from mvrecon.models.output import Reconstruction


def edge_difference(a: Float[Tensor, "b 1 d h w"], b: Float[Tensor, "b 1 d h w"]) -> Float[Tensor, ""]:
    """Mean squared difference of the first differences along the three axes: edges count, offsets do not."""
    error = a - b
    return torch.stack([error.diff(dim=axis).square().mean() for axis in (2, 3, 4)]).mean()


class ReconstructionLoss(nn.Module):
    """Error of the volume, of each camera's own volume, and of what each predicts for the others.

    Args:
        data_range: value range of the volumes, in their unit.
        volume: weight of the mean squared error.
        edges: weight of the squared error of first differences.
        opinions: weight of the mean squared error of the opinions, where the cameras see.
        cross_view: weight of the squared error of opinions seen by the other cameras, relative to the views.
    """

    def __init__(
        self,
        data_range: float,
        volume: float = 1.0,
        edges: float = 0.0,
        opinions: float = 0.1,
        cross_view: float = 0.01,
    ):
        super().__init__()
        if not data_range > 0:
            raise ValueError(f"data_range must be positive, got {data_range}")
        self.data_range = data_range
        self.weights = {"volume": volume, "edges": edges, "opinions": opinions, "cross_view": cross_view}

    def forward(self, out: Reconstruction, batch: dict[str, Tensor]) -> dict[str, Float[Tensor, ""]]:
        """Each term unweighted, and their weighted sum as "total"."""
        truth, views = batch["volume"] / self.data_range, batch["views"]
        volume = out.volume / self.data_range
        terms = {"volume": F.mse_loss(volume, truth)}
        if self.weights["edges"]:
            terms["edges"] = edge_difference(volume, truth)
        if out.opinions is not None and out.visible is not None and self.weights["opinions"]:
            error = (out.opinions / self.data_range - truth[:, None]).square() * out.visible
            terms["opinions"] = error.mean() / out.visible.float().mean()
        if out.cross_views is not None and self.weights["cross_view"]:
            power = views.square().mean().clamp_min(torch.finfo(views.dtype).tiny)
            terms["cross_view"] = (out.cross_views - views).square().mean() / power
        total = sum(self.weights[name] * value for name, value in terms.items())
        return {**terms, "total": torch.as_tensor(total)}
